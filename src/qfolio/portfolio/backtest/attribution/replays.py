"""Replays of a policy that sees some of its channels shuffled.

Two kinds of shuffle take a channel's information away but keep its distribution: the assets swap
their values, or blocks of rows swap places. Assets are relabeled anew every quarter of a year, not
every row: otherwise a slow signal would become noise that a policy pays costs to follow, and its
value would be confused with that of trading less. Prices and costs are unchanged.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, PyTree

from qfolio.core.mdp import Agent, task_jit
from qfolio.portfolio import signals
from qfolio.portfolio.backtest.folds import tested
from qfolio.portfolio.backtest.replay import Stretch
from qfolio.portfolio.following import begin, paths
from qfolio.portfolio.market import Holding
from qfolio.portfolio.menu import Signalled
from qfolio.portfolio.task import Portfolio

AT_ONCE = 16
"""Most replays in one vectorized loop; all their inputs and weights are in memory at once."""


class Observed(Portfolio):
    """A portfolio whose observed channels are given, with those of row ``begin`` first."""

    observed: Float[Array, "seen asset channel"] = eqx.field(kw_only=True)  # NaN where unknown
    begin: Int[Array, ""] = eqx.field(kw_only=True)

    @staticmethod
    def given(task: Portfolio, observed: Array, begin: Array) -> "Observed":
        own = {field.name: getattr(task, field.name) for field in dataclasses.fields(task)}
        return Observed(**own, observed=observed, begin=begin)

    def features(self, market: Int[Array, ""]) -> Float[Array, "asset time channel"]:
        start = market - self.window + 1 - self.begin
        window = lax.dynamic_slice_in_dim(self.observed, start, self.window)
        return jnp.swapaxes(self.scaled(window), 0, 1)

    def signalled(self, market: Int[Array, ""]) -> Signalled | None:
        found = super().signalled(market)
        if found is None:
            return None
        latest = lax.dynamic_index_in_dim(self.observed, market - self.begin, keepdims=False)
        return found._replace(signals=jnp.nan_to_num(latest[:, latest.shape[1] - self.tilting :]))


class Shuffle(NamedTuple):
    """What a replay shuffles.

    mask: 1 for each shuffled channel. rows, assets: index of the draw of each kind; 0 for none.
    """

    mask: np.ndarray  # (channel,)
    rows: int
    assets: int


class Shuffles(NamedTuple):
    """Draws of both kinds over the rows that a test observes; draw 0 leaves all in place."""

    begin: int  # first of these rows
    rows: np.ndarray  # (draw, row): the row that is seen instead
    assets: np.ndarray  # (draw, row, asset): the asset that is seen instead
    shared: np.ndarray  # (channel,): whether it is the same for all assets
    own: Array  # (row, asset, channel): the channels on all rows of the table
    others: Array  # likewise: what is seen instead

    @staticmethod
    def drawn(stretches: Sequence[Stretch], count: int, block: int, seed: int) -> "Shuffles":
        """Draws with a fixed seed, in blocks of rows; assets tradable throughout are relabeled."""
        task, folds = stretches[0].task, [fold for *_, fold in stretches]
        longest, decided = max(fold.days for fold in folds), tested(folds)
        begin, end = decided.start - task.window + 1, decided.stop
        length, assets = end - begin, task.limits.shape[0]
        block = max(1, min(block, length // 4))
        rng = np.random.default_rng(seed)
        rows = np.tile(np.arange(begin, end, dtype=np.int32), (count + 1, 1))
        shown = np.tile(np.arange(assets, dtype=np.int32), (count + 1, length, 1))
        pieces = np.array_split(np.arange(begin, end), max(1, length // block))
        there = np.ones((end, assets), bool) if task.tradable is None else np.asarray(task.tradable)
        starts = np.array([fold.decisions.start for fold in folds])
        for draw in range(1, count + 1):
            rows[draw] = np.concatenate([pieces[i] for i in rng.permutation(len(pieces))])
            for piece in pieces:
                # Tradable in the fold that decides in these rows.
                fold = max(0, int(np.searchsorted(starts, piece[0], side="right")) - 1)
                limits = np.asarray(stretches[fold].task.limits)
                swapped = np.flatnonzero((limits > 0) & there[piece].all(0))
                shown[draw, piece - begin, swapped[:, None]] = rng.permutation(swapped)[:, None]
        # The last fold is followed beyond its end, as long as the longest.
        pad = ((0, 0), (0, longest))
        rows, shown = np.pad(rows, pad, "edge"), np.pad(shown, (*pad, (0, 0)), "edge")
        own = others = channels(task)
        shared = shared_channels(stretches)
        if task.tradable is not None:
            # Where an asset is not tradable its channels are unknown. It may be tradable in the row
            # that sees them, so it gets those that all share from another.
            common = own[jnp.arange(len(own)), task.tradable.argmax(1)]
            others = jnp.where(jnp.asarray(shared), common[:, None], own)
        return Shuffles(begin, rows, shown, shared, own, others)


class Replays(NamedTuple):
    """The decisions of R replays over D days."""

    targets: np.ndarray  # (R, D, entry)
    held: np.ndarray  # (R, D, entry): weights held when deciding


def channel_names(task: Portfolio, feature_names: Sequence[str]) -> list[str]:
    """The names of the channels that agents observe, in order."""
    return ["log return", *feature_names, *signals.labels(task.signals)]


def channels(task: Portfolio) -> Float[Array, "row asset channel"]:
    """All channels on all rows of the table, before scaling; NaN where unknown."""
    return jnp.concatenate([task.log_relatives[..., None], task.extra], -1)


def seen_in_test(stretches: Sequence[Stretch]) -> np.ndarray:
    """All channels on the days of the test, before scaling; their means where unknown."""
    task, days = stretches[0].task, tested([fold for *_, fold in stretches])
    found = np.asarray(channels(task))[days]
    return np.where(np.isnan(found), np.asarray(task.center), found)


def open_to(stretches: Sequence[Stretch]) -> np.ndarray:
    """Which assets the fold, the mandate and the table let be bought, of shape (days, assets)."""
    days = [fold.days for *_, fold in stretches]
    allowed = np.repeat([np.asarray(task.limits) > 0 for task, *_ in stretches], days, axis=0)
    tradable, begin = stretches[0].task.tradable, stretches[0].fold.decisions.start
    if tradable is None:
        return allowed
    return np.asarray(allowed & np.asarray(tradable)[begin : begin + len(allowed)])


def shared_channels(stretches: Sequence[Stretch]) -> np.ndarray:
    """Whether a channel is the same for all assets that may be bought on the days of the test."""
    shown, there = seen_in_test(stretches), open_to(stretches)
    least = (np.where(there, each, np.inf).min(1) for each in np.moveaxis(shown, -1, 0))
    most = (np.where(there, each, -np.inf).max(1) for each in np.moveaxis(shown, -1, 0))
    return np.array([bool((x <= y).all()) for x, y in zip(most, least, strict=True)])


def replay(
    agent: Agent, stretches: Sequence[Stretch], shuffles: Shuffles, wanted: Sequence[Shuffle]
) -> Iterator[Replays]:
    """Follows the mean of all seeds over all folds, once for each shuffle that is wanted.

    The replays come in groups of at most ``AT_ONCE``, so that not all weights are in memory.
    """
    groups = -(-len(wanted) // AT_ONCE)
    size = -(-len(wanted) // groups)  # the same for all, so that one program serves them
    for first in range(0, len(wanted), size):
        given = list(wanted[first : first + size])
        padded = given + given[-1:] * (size - len(given))
        found = _replay(agent, stretches, shuffles, padded)
        yield Replays(*(each[: len(given)] for each in found))


def _replay(
    agent: Agent, stretches: Sequence[Stretch], shuffles: Shuffles, wanted: Sequence[Shuffle]
) -> Replays:
    masks, rows, assets = (jnp.asarray(np.array(x)) for x in zip(*wanted, strict=True))
    longest = max(fold.days for *_, fold in stretches)
    cash = np.eye(shuffles.own.shape[1] + 1)[:1]
    held = begin(stretches[0].task, np.repeat(cash, len(wanted), 0))
    targets, before = [], []
    for task, members, fold in stretches:
        start, count = fold.decisions.start, fold.days
        here = slice(start - task.window + 1 - shuffles.begin, None)
        seen = slice(here.start, here.start + task.window - 1 + longest)
        drawn = [jnp.asarray(x[:, seen]) for x in (shuffles.rows, shuffles.assets)]
        together = jax.tree.map(lambda x: x[None], members)
        first = jnp.array(start, jnp.int32)
        ends = _paths(
            task,
            (shuffles.own, shuffles.others),
            agent,
            together,
            first,
            held,
            (*drawn, masks, rows, assets),
            longest,
        )
        ordered, after = jax.tree.map(np.asarray, ends)
        targets.append(ordered[:, :count])
        start_held = np.asarray(held.weights)[:, None]
        before.append(np.concatenate([start_held, after.weights[:, : count - 1]], 1))
        held = jax.tree.map(lambda x, last=count - 1: x[:, last], after)
    return Replays(np.concatenate(targets, 1), np.concatenate(before, 1))


@task_jit
def _paths(
    task: Portfolio, raw: tuple[Array, Array], agent: Agent, members: PyTree, first: Array,
    held: Holding, shuffled: tuple[Array, ...], count: int,
) -> tuple[Float[Array, "replay time entry"], Holding]:  # fmt: skip
    rows, assets, masks, *draws = shuffled
    own, others = raw

    def one(given: tuple[Any, ...]) -> tuple[Array, Holding]:
        held, mask, row_draw, asset_draw = given
        seen = jnp.take_along_axis(others[rows[row_draw]], assets[asset_draw][..., None], 1)
        mixed = jnp.where(mask > 0, seen, own[rows[0]])
        blind = Observed.given(task, mixed, first - task.window + 1)
        start = jax.tree.map(lambda x: x[None], held)
        found = paths(blind, agent, members, first, start, count)
        _, targets, after = jax.tree.map(lambda x: x[0], found)
        return targets, after

    found: tuple[Array, Holding] = jax.vmap(one)((held, masks, *draws))
    return found
