"""A learned portfolio policy: from prices and holdings to target weights.

The policy is the mean over the agents of all seeds. It lives in a folder: what it was trained with
(JSON), its weights, and the whole learning state, from which it can go on learning.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from numbers import Real
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PyTree

from qfolio.core import settings
from qfolio.core.errors import QfolioError
from qfolio.core.files import new_folder, read_json, read_tree, write_json, write_tree
from qfolio.core.market import View
from qfolio.core.mdp import Agent
from qfolio.core.population import Population
from qfolio.core.registry import build, name_of
from qfolio.core.training import episode_steps
from qfolio.experiments.budget import Budget, seed_range
from qfolio.experiments.fit import Listener, fit
from qfolio.experiments.presets import Preset, preset
from qfolio.portfolio.costs import drift
from qfolio.portfolio.prices.findings import day
from qfolio.portfolio.prices.table import Prices, load
from qfolio.portfolio.task import Portfolio

FORMAT = 2
"""Of a policy's folder; raised whenever an older folder can no longer be read."""

UPDATE_RATE = 0.1
"""Share of the learning rate with which a policy goes on learning."""

UNKNOWN = np.datetime64("NaT", "s")


def train(
    prices: Any,
    agent: str | Preset | Agent = "pathwise",
    *,
    seeds: int | None = None,
    seed: int = 0,
    episodes: int | None = None,
    listeners: Sequence[Listener] = (),
    **task: Any,
) -> "Policy":
    """A policy that has learned from all rows of a price table, all seeds in one program.

    Args:
        prices: Anything that ``prices.load`` reads.
        agent: The name of an agent, for its fast preset; a preset; or an agent, which then needs
            ``episodes``.
        seeds, seed: Number of agents, with the seeds ``seed``, ``seed + 1``, …; the preset's
            number, or 5.
        episodes: That each agent is trained for; the preset's, if not named.
        task: Settings of the portfolio task (cost, lag, window, …) in place of the preset's.

    Raises:
        QfolioError: Table, settings and agent do not fit together, or a loss is not finite.
    """
    table = load(prices)
    if isinstance(agent, str):
        agent = preset("fast", "portfolio", agent)
    if isinstance(agent, Preset):
        task = {**agent.task, **task}
        episodes = agent.episodes if episodes is None else episodes
        seeds = agent.seeds if seeds is None else seeds
        agent = agent.build()
    if episodes is None:
        raise QfolioError("An agent without a preset needs to be told how many episodes to train.")
    count = 5 if seeds is None else seeds
    portfolio = Portfolio.of(table, **settings.convert(Portfolio, task))
    population = Population(portfolio, agent, seed_range(count, seed))
    _learn(population, episodes, listeners)
    learner = population.fetch().agent
    return Policy(
        portfolio,
        agent,
        agent.weights(learner),
        table.assets,
        table.feature_names,
        learner,
        learned=table.dates[-1],
    )


class Policy:
    """Agents of one kind and several seeds, trained on the assets of one table.

    task: the portfolio task, with the part of the table that they were trained on.
    members: what each agent learned, with a leading seed axis.
    learner: the agents' whole states, likewise; without, the policy cannot be updated.
    updates: how often it has gone on learning.
    learned: the date of the last row that it has learned from; NaT where that is not known.
    """

    def __init__(
        self,
        task: Portfolio,
        agent: Agent,
        members: PyTree,
        assets: Sequence[str],
        features: Sequence[str] = (),
        learner: PyTree = None,
        updates: int = 0,
        learned: np.datetime64 = UNKNOWN,
    ) -> None:
        self.task, self.agent, self.members = task, agent, members
        self.assets, self.features = tuple(assets), tuple(features)
        self.learner, self.updates, self.learned = learner, updates, learned

    def weights(self, prices: Any, holdings: Any = None, **options: Any) -> dict[str, float]:
        """Target weights after the last row of a price table, by asset, with "cash" first.

        Args:
            prices: A price table with the assets that the policy was trained on, in any order, and
                at least as many rows as its window has; anything that ``prices.load`` reads, with
                its options.
            holdings: Weights held now, by asset (what is left is cash); None for cash alone.

        Raises:
            QfolioError: The assets are not those of the policy, or prices are missing in its
                window.
        """
        table = self.table(prices, **options)
        targets, _ = self.decide(table, len(table) - 1, self.holdings(holdings), 1)
        return dict(zip(("cash", *self.assets), targets[0].tolist(), strict=True))

    def update(
        self,
        prices: Any,
        episodes: int | None = None,
        *,
        listeners: Sequence[Listener] = (),
        **options: Any,
    ) -> "Policy":
        """The policy after it has gone on learning from the last rows of a newer table.

        It looks at as many rows as it was first trained on, and keeps the scale of its
        observations. Networks and optimiser go on from where they were, at a constant tenth of the
        learning rate; what was stored of the old table is forgotten.

        Args:
            prices: As for ``weights``.
            episodes: In which each agent learns; one for each of its environments, if not named.

        Raises:
            QfolioError: The learning state was not kept, the table does not fit, or it has no row
                that is newer than those that were learned from.
        """
        if self.learner is None:
            raise QfolioError(
                "This policy was kept without its learning state and cannot go on learning; train "
                "it anew."
            )
        wanted = self.agent.num_envs if episodes is None else episodes
        _ = Budget(wanted)
        table = self.table(prices, **options)
        if table.dates[-1] <= self.learned:
            raise QfolioError(
                f"The prices end on {day(table.dates[-1])}, and the policy has learned from those "
                f"up to {day(self.learned)} already: there is nothing new to learn; bring newer "
                "prices, or go without an update."
            )
        table = table.between(max(0, len(table) - self.rows), None)
        task = self._moved(table)
        of_now: Any = self.agent
        agent: Agent = dataclasses.replace(
            of_now,
            learning_rate=of_now.learning_rate * UPDATE_RATE,
            learning_rate_final=1.0,  # the cosine may have come to its end
        )
        draws = [np.random.SeedSequence((i, self.updates + 1)) for i in range(self.seeds)]
        seeds = [int(draw.generate_state(1)[0]) for draw in draws]
        unlearned = -(-agent.warm_up() // episode_steps(task, agent)) * agent.num_envs
        population = Population(task, agent, seeds)
        state = population.fetch()
        learner = agent.carry_over(self.learner, state.agent)
        population.restore(eqx.tree_at(lambda s: s.agent, state, learner))
        _learn(population, unlearned + wanted, listeners)
        learner = population.fetch().agent
        return Policy(
            task,
            self.agent,
            agent.weights(learner),
            self.assets,
            self.features,
            learner,
            self.updates + 1,
            table.dates[-1],
        )

    @property
    def seeds(self) -> int:
        return int(jax.tree.leaves(self.members)[0].shape[0])

    @property
    def rows(self) -> int:
        """Of the part of a table that it was trained on."""
        return int(self.task.last) - int(self.task.first) + self.task.window + self.task.lag + 2

    def table(self, prices: Any, **options: Any) -> Prices:
        """The prices with the policy's assets in its order; see ``weights``."""
        table = load(prices, **options)
        missing = [name for name in self.assets if name not in table.assets]
        unknown = [name for name in table.assets if name not in self.assets]
        if missing or unknown:
            said = [f"without {_list(missing)}"] * bool(missing)
            said += [f"with {_list(unknown)}, unknown to the policy"] * bool(unknown)
            raise QfolioError(
                f"The price table is {' and '.join(said)}; it must have the {len(self.assets)} "
                "assets that the policy was trained on, and no others."
            )
        if table.feature_names != self.features:
            raise QfolioError(
                f"The price table has {_list(list(table.feature_names)) or 'none'} as further "
                f"features; the policy was trained with {_list(list(self.features)) or 'none'}."
            )
        if len(table) <= self.task.window:
            raise QfolioError(
                f"The price table has {len(table)} rows; the policy's window needs at least "
                f"{self.task.window + 1}."
            )
        table = table.select(self.assets)
        # An asset that may be held needs a price all over the window, the others one at its end.
        tradable, last = np.asarray(self.task.largest) > 0, len(table) - 1
        begin = last - self.task.window
        late = table.first_rows > np.where(tradable, begin, last)
        if late.any():
            raise QfolioError(
                f"The policy's window begins on {day(table.dates[begin])}, when there was no price "
                f"of {_list([n for n, is_late in zip(self.assets, late, strict=True) if is_late])} "
                "yet; bring earlier prices, or wait until there are enough."
            )
        return table

    def holdings(self, holdings: Mapping[str, float] | None) -> np.ndarray:
        """Weights with cash first, from weights by asset."""
        held = np.zeros(1 + len(self.assets))
        given = {} if holdings is None else dict(holdings)
        for name, weight in given.items():
            if name != "cash" and name not in self.assets:
                raise QfolioError(f"The holdings name {name!r}, which the policy does not know.")
            if not isinstance(weight, Real) or not 0 <= weight <= 1 + 1e-9:
                raise QfolioError(
                    f"The weight of {name!r} is {weight!r}; it must be a number from 0 to 1."
                )
            held[0 if name == "cash" else 1 + self.assets.index(name)] = weight
        total = held[1:].sum()
        if total > 1 + 1e-9 or ("cash" in given and abs(held.sum() - 1) > 1e-6):
            raise QfolioError(f"The weights held sum to {held.sum():.6g}; they must sum to 1.")
        held[0] = max(0.0, 1 - total)
        return held / held.sum()

    def decide(
        self, prices: Prices, first: int, held: np.ndarray, count: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Target weights at ``count`` rows from ``first`` on, and what is held after each.

        held: at row ``first``, shape (entry,). Both results are (count, entry); the second is
        drifted to the row after each decision.
        """
        task = on_table(self.task, prices)
        results = follow(task, self.agent, self.members, first, held[None], count, together=True)
        targets, after = (x[0].astype(float) for x in results)
        return tuple(x / x.sum(-1, keepdims=True) for x in (targets, after))

    def save(self, folder: Path | str) -> None:
        """Writes it into a new or empty folder."""
        with new_folder(Path(folder)) as place:
            write_json(
                place / "policy.json",
                {
                    "format": FORMAT,
                    "kind": "policy",
                    "agent": name_of(self.agent),
                    "settings": settings.describe(self.agent),
                    "task": settings.describe(self.task),
                    "assets": list(self.assets),
                    "features": list(self.features),
                    "seeds": self.seeds,
                    "rows": self.rows,
                    "updates": self.updates,
                    "learned": str(self.learned),
                    "learns": self.learner is not None,
                },
            )
            kept = jax.tree.map(np.asarray, _kept(self.task, self.members))
            write_tree(place / "policy.safetensors", kept)
            if self.learner is not None:
                write_tree(place / "learning.safetensors", self.learner)

    @classmethod
    def open(cls, folder: Path | str) -> "Policy":
        """What ``save`` wrote. Raises QfolioError where the folder holds no policy."""
        path = Path(folder) / "policy.json"
        config = read_json(path)
        if config.get("format") != FORMAT or config.get("kind") != "policy":
            raise QfolioError(f"{folder} holds no policy of this version.")
        try:
            agent: Agent = build("agent", config["agent"], config["settings"])
            chosen = settings.convert(Portfolio, config["task"])
            assets, features = tuple(config["assets"]), tuple(config["features"])
            seeds, rows, updates = (int(config[name]) for name in ("seeds", "rows", "updates"))
            learned, learns = np.datetime64(config["learned"], "s"), bool(config["learns"])
            bounds = (len(assets) > 0, 1 <= seeds < 2**20, 1 <= rows < 2**31, updates >= 0)
            if not all(bounds) or not all(isinstance(name, str) for name in assets + features):
                raise ValueError
        except (KeyError, TypeError, ValueError, AttributeError):
            raise QfolioError(f"{path} is damaged: a setting is missing or odd.") from None
        task = _blank(len(assets), len(features), rows, **chosen)
        state = state_template(task, agent, seeds)
        template = _kept(task, agent.weights(state))
        kept = read_tree(path.with_name("policy.safetensors"), template)
        members = kept.pop("members")
        task = dataclasses.replace(task, **jax.tree.map(jnp.asarray, kept))
        learner = read_tree(path.with_name("learning.safetensors"), state) if learns else None
        return cls(task, agent, members, assets, features, learner, updates, learned)

    def _moved(self, table: Prices) -> Portfolio:
        """The task on all rows of another table, with the scale of the old one."""
        task = on_table(self.task, table)
        tradable = ~np.isnan(table.values[0])
        part = task.part(0, len(table) - 1, tradable)
        where = lambda t: (t.center, t.scale)  # noqa: E731
        return eqx.tree_at(where, part, where(self.task))


def _kept(task: Portfolio, members: PyTree) -> dict[str, PyTree]:
    """What a policy decides by, but for its settings."""
    return {
        "members": members,
        "center": task.center,
        "scale": task.scale,
        "largest": task.largest,
    }


def _blank(assets: int, features: int, rows: int, **chosen: Any) -> Portfolio:
    """A task that was trained on so many rows, of whose table nothing is left."""
    task = Portfolio(
        log_relatives=jnp.zeros((0, assets)),
        extra=jnp.zeros((0, assets, features)),
        largest=jnp.zeros(assets),
        center=jnp.zeros(1 + features),
        scale=jnp.ones(1 + features),
        first=jnp.array(0, jnp.int32),
        last=jnp.array(0, jnp.int32),
        **chosen,
    )
    shown = (jnp.zeros((task.window, assets)), jnp.zeros((task.window, assets, features)))
    last = jnp.array(rows - task.lag - 2, jnp.int32)
    where = lambda t: (t.log_relatives, t.extra, t.first, t.last)  # noqa: E731
    return eqx.tree_at(where, task, (*shown, jnp.array(task.window, jnp.int32), last))


def state_template(task: Portfolio, agent: Agent, seeds: int) -> PyTree:
    """Shapes of the agents' whole states, with a leading seed axis."""
    state = jax.eval_shape(lambda: agent.init(task, jax.random.key(0)))
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((seeds, *x.shape), x.dtype), state)


def on_table(task: Portfolio, prices: Prices) -> Portfolio:
    """The same task, scaled by what it was trained on, over all rows of another table."""
    other = Portfolio.arrays(prices)
    rows = jnp.array(len(prices) - 1, jnp.int32)
    where = lambda t: (t.log_relatives, t.extra, t.first, t.last)  # noqa: E731
    return eqx.tree_at(where, task, (*other, jnp.array(task.window, jnp.int32), rows))


def follow(
    task: Portfolio,
    agent: Agent,
    members: PyTree,
    first: int,
    held: np.ndarray,
    count: int,
    *,
    together: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Greedy decisions from row ``first`` on: of each member by itself, or of all together.

    Together, they hold one portfolio and follow the mean of their targets.

    held: at row ``first``, shape (seed, entry), or (1, entry) if together. The results are target
    weights, and what is held one row after each decision, both (seed or 1, count, entry).
    """
    portfolios = jax.tree.map(lambda x: x[None] if together else x[:, None], members)
    start = jnp.array(first, jnp.int32), jnp.asarray(held, jnp.float32)
    targets, after = _follow(task, agent, portfolios, *start, count)
    return np.asarray(targets), np.asarray(after)


@eqx.filter_jit(donate="none")
def _follow(
    task: Portfolio, agent: Agent, members: PyTree, first: Array, held: Array, count: int
) -> tuple[Float[Array, "portfolio time entry"], Float[Array, "portfolio time entry"]]:
    """members: with leading axes (portfolio, member); a portfolio follows the mean of its own."""

    def step(members: PyTree, held: Array, row: Array) -> tuple[Array, tuple[Array, Array]]:
        view = View(task.features(row)[None], held[None, 1:])

        def one(weights: PyTree) -> Array:
            return task.target(held, agent.policy(weights, view)[0])

        target = jax.vmap(one)(members).mean(0)
        after = drift(target, task.relatives(row, row).coming)
        return after, (target, after)

    def path(members: PyTree, held: Array) -> tuple[Array, Array]:
        return lax.scan(partial(step, members), held, first + jnp.arange(count))[1]

    return jax.vmap(path)(members, held)


def _learn(population: Population, episodes: int, listeners: Sequence[Listener]) -> None:
    """Raises KeyboardInterrupt where Ctrl-C stopped it: half a training makes no policy."""
    if not fit(population, Budget(episodes), listeners).finished:
        raise KeyboardInterrupt


def _list(names: list[str]) -> str:
    shown = ", ".join(map(repr, names[:3]))
    return shown + (f" and {len(names) - 3} more" if len(names) > 3 else "")
