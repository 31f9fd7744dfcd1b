"""An agent of your own: constant weights, learned by gradient ascent through the market."""

import jax
import jax.numpy as jnp

import qfolio
from qfolio.core.fields import number, static
from qfolio.core.mdp import Agent
from qfolio.portfolio.synthetic.merton import Merton


class Constant(Agent):
    """Its state is one logit for cash and one for each asset."""

    num_envs: int = static(32)
    episode_steps: int = static(0)  # training episodes last as long as the task's horizon
    rollout_steps: int = static(25)  # of each environment, before the agent learns
    learning_rate: float = number(30.0)

    discount = None  # it estimates no values

    def init(self, task, key):
        return jnp.zeros(1 + task.actions.assets)

    def act(self, state, observation, key):
        return self.policy(state, observation)

    def learn(self, task, state, rollout, key):
        before, after = rollout.state, rollout.next_state

        def reward(logits):
            def settle(market, moved, holding):
                return task.settle(market, moved, holding, jax.nn.softmax(logits))[0]

            each_step = jax.vmap(jax.vmap(settle))
            return each_step(before.market, after.market, before.holding).mean()

        gained, gradient = jax.value_and_grad(reward)(state)
        return state + self.learning_rate * gradient, {"reward": gained}

    def weights(self, state):
        return state

    def policy(self, weights, observation):
        batch = observation.holding.shape[0]
        return jnp.broadcast_to(jax.nn.softmax(weights), (batch, len(weights)))


# In Merton's market constant weights are optimal, so that the regret of this agent should vanish.
run = qfolio.train(Merton(), Constant(), steps=200_000, seeds=4)
for seed, regret in enumerate(run.grade()["regret_per_seed"]):
    print(f"seed {seed}: {regret:.2%} of the best growth is missed")
