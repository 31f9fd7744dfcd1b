"""What reports call tasks and agents, and say of them."""

from typing import NamedTuple

from qfolio.core.registry import GYM, short


class Words(NamedTuple):
    where: str  # an agent was trained, for the title
    about: str = ""
    meaning: str = ""  # of a return, where it is more than the sum of rewards
    rule: str = ""  # what the numbers of its rule are
    scene: str = "{}"  # what the name of a scene stands for


_WEIGHT_WANTED = "Each number is the weight that is wanted, from a weight that is held."

TASKS = {
    "pendulum": Words("on the pendulum"),
    "pendulum/grid": Words("on the pendulum seen through a grid"),
    "pendulum/hidden": Words("on the pendulum without its velocity"),
    "catch": Words("at catching a ball among decoys"),
    "finite/cliff": Words("at the cliff"),
    "finite/frozen-lake": Words("on the frozen lake"),
    "finite/random": Words("on a random finite process"),
    "market/kelly": Words(
        "on Kelly’s bet",
        "A bet on good odds, repeated. The best policy stakes one fraction of the wealth, whatever "
        "is at stake already (Kelly, 1956).",
        rule="The fraction is the share of the wealth at stake.",
    ),
    "market/merton": Words(
        "in Merton’s market",
        "Three assets and cash with the same chances at every step. The best weights therefore "
        "never change (Merton, 1969), and here one of the assets is not worth holding.",
        rule="What the three weights leave is held in cash.",
    ),
    "market/regime": Words(
        "in a market of good and bad times",
        "One asset rises in good times and falls in bad ones, and trading costs. The best policy "
        "is all in or all out, and changes over only where that earns more than it costs.",
        rule=_WEIGHT_WANTED,
        scene="{} times",
    ),
    "market/ar1": Words(
        "in a market with a signal",
        "A slowly fading signal foretells the return of one asset, and trading costs. The best "
        "policy, computed for weights in tenths, moves only where the signal is worth the cost, "
        "and else keeps what it holds.",
        rule=f"{_WEIGHT_WANTED} Signals are in standard deviations.",
        scene="signal {}",
    ),
    "market/no-trade": Words(
        "in a market with a no-trade region",
        "One asset grows faster than cash, and trading costs. The best policy does nothing inside "
        "a region of weights; outside of it, it trades just to the nearest edge.",
        "Each step counts with its expected growth, so that the luck of its price does not.",
        rule="Low and high are the edges of the region: where a holder of too little stops buying, "
        "and a holder of too much stops selling.",
    ),
    "market/garleanu-pedersen": Words(
        "in the market of Gârleanu and Pedersen",
        "A fading signal foretells the return of one asset, and costs grow with the square of a "
        "trade. The best policy therefore goes only part of the way to where it aims (Gârleanu "
        "and Pedersen, 2013).",
        "It counts what a position earns, less its risk and the costs of trading, each step "
        "discounted.",
        rule="What is wanted is a sum of two parts. The coefficient of the position held is one "
        "less the trading rate; the other is that of the factor, the signal.",
    ),
}
"""What the report says of a task, by name."""

AGENTS = {
    "dqn": "DQN",
    "pathwise": "Pathwise gradients",
    "q-learning": "Q-learning",
    "sarsa": "SARSA",
    "expected-sarsa": "Expected SARSA",
    "double-q": "Double Q-learning",
    "dyna-q": "Dyna-Q",
    "reinforce": "REINFORCE",
    "a2c": "A2C",
    "ppo": "PPO",
    "ddpg": "DDPG",
    "td3": "TD3",
    "sac": "SAC",
    "mbpo": "MBPO",
}
"""What the report calls an agent, by name."""


def words_of(task: str) -> Words:
    """What the report says of a task; of one that is not registered, its name alone."""
    return TASKS.get(task, Words(f"on {short(task.removeprefix(GYM))}"))


def agent_name(agent: str) -> str:
    """What the report calls an agent; one that is not qfolio's by the name of its class."""
    return AGENTS.get(agent, short(agent))
