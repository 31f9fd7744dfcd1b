"""A portfolio of assets with given prices.

State: the row of the price table and the portfolio. Observation: for each asset, a window of log
returns, of the table's features and of signals, and the current weights. Action: target weights, or
a choice from a menu. A decision sees prices up to row t, is executed at the close of row t + lag,
and earns the return from there to the next row. No observation at t depends on a later price.
"""

import dataclasses
import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from qfolio.core import simplex
from qfolio.core.errors import QfolioError, TooFewRowsError, require_type
from qfolio.core.fields import constant, number, require, static
from qfolio.core.keys import apart
from qfolio.core.mdp import Actions, Box, Position, Simplex
from qfolio.core.registry import own_modules
from qfolio.portfolio import anchors, signals, universe
from qfolio.portfolio.backtest.baselines import baseline
from qfolio.portfolio.calendars import band, calendar_years, decision_rows
from qfolio.portfolio.conditions import Conditions
from qfolio.portfolio.costs import cashed, require_sound
from qfolio.portfolio.execution import Plan, Terms
from qfolio.portfolio.mandate import checks
from qfolio.portfolio.mandate.feasible import CappedSimplex, Feasible, Mandated
from qfolio.portfolio.mandate.limits import (
    buyable,
    feasible,
    largest_weight,
    mandate_text,
    parse,
    reach,
)
from qfolio.portfolio.mandate.mandate import Mandate
from qfolio.portfolio.mandate.risk import Past, Risk, covariances
from qfolio.portfolio.market import Contexts, Holding, Market, Relatives
from qfolio.portfolio.menu import Signalled
from qfolio.portfolio.prices.table import Prices
from qfolio.portfolio.universe import Patterns

Row = Int[Array, ""]

LEAST = 1e-6
"""Share of an anchor that is spread equally."""

RARE = 0.75
"""A channel that is unknown at more than this share of rows is not enlarged: the few others say
little about its scale."""

CONSTANT = 1e-5
"""A channel whose deviation is less than this share of its mean is constant, up to rounding."""


class Portfolio(Market):
    """Trade the assets of a price table; each episode covers ``horizon`` consecutive rows.

    ``Portfolio.of(prices)`` uses all rows, ``part`` some of them.
    """

    log_relatives: Float[Array, "row asset"]  # log return from the row before; 0 if unknown
    extra: Float[Array, "row asset feature"]  # the features, then signals; NaN if unknown
    anchors: Float[Array, "anchored asset"]  # weights of the anchor; no rows without one
    limits: Float[Array, " asset"]  # largest weight of each asset; 0 where it cannot be traded
    center: Float[Array, " channel"]  # subtracted from each observed channel; from the part's rows
    scale: Float[Array, " channel"]  # divides each observed channel; likewise
    conditions: Conditions  # the columns that the cost model reads; empty if it reads none
    decides: Bool[Array, " decision"]  # whether a decision is due at each row; no rows if always
    elapsed: Float[Array, " dated"]  # years at each row, see Terms; no rows if unused
    benchmarks: Float[Array, "benchmarked asset"]  # a benchmark's weights; no rows without one
    covariances: Float[Array, "estimated asset asset"]  # of returns; no rows without limits on risk
    joined: Int[Array, " asset"]  # the row of an asset's first price
    year: Float[Array, ""]  # rows in a year
    tradable: Bool[Array, "row asset"] | None  # at each row; None if all assets always are
    first_decision: Row
    last_decision: Row
    window: int = static(60)  # rows that are observed
    lag: int = static(1)  # rows from a decision to its execution
    cost: float = constant(0.001)  # one way, as a share of the value traded
    cost_model: str = static("proportional")
    calendar: str = static("")  # of decisions, see portfolio.calendars; no trades between them
    max_weight: float = constant(1.0)  # of one asset
    mandate: str = static("")  # text of a mandate, see portfolio.mandate
    menu: str = static("")
    signals: str = static("")  # names of signals that are observed, see portfolio.signals
    signal_scale: str = static("rank")  # of signals: rank, z-score, centered or raw
    anchor: str = static("")  # weights that agents may depart from, see portfolio.anchors
    reward: str = static("log")
    active: bool = static(False)  # rewards are in excess of the anchor's
    tracking_aversion: float = number(0.0)  # half of it times the squared active reward is deducted
    risk_aversion: float = number(3.0)
    sharpe_rate: float = number(0.01)
    horizon: int = static(50)
    allowed: Mandated | None = None  # the weights that the mandate allows, if there is one
    patterns: Patterns | None = None  # the mandate's limits where assets come and go

    @staticmethod
    def of(prices: Prices, **settings: Any) -> "Portfolio":
        """A task on all rows of a table.

        mandate: anything that ``limits.mandate_text`` takes. Raises QfolioError if it cannot be
        met.
        """
        require_type("prices", prices, Prices, "a table that qfolio.load_prices has read")
        if "mandate" in settings:
            settings["mandate"] = mandate_text(settings["mandate"], prices.assets)
        task = Portfolio.blank(len(prices.assets), len(prices.feature_names), **settings)
        if task.mandate:
            checks.require(task.mandate, np.ones(len(prices.assets), bool), task.max_weight)
        return task.on_rows(prices)

    @staticmethod
    def blank(assets: int, features: int, **settings: Any) -> "Portfolio":
        """A task without prices."""
        channels = features + len(signals.parse(settings.get("signals", "")))
        return Portfolio(
            log_relatives=jnp.zeros((0, assets)),
            extra=jnp.zeros((0, assets, channels)),
            anchors=jnp.zeros((0, assets)),
            limits=jnp.zeros(assets),
            center=jnp.zeros(1 + channels),
            scale=jnp.ones(1 + channels),
            conditions=Conditions(jnp.zeros(0), {}, {}),
            decides=jnp.zeros(0, bool),
            elapsed=jnp.zeros(0),
            benchmarks=jnp.zeros((0, assets)),
            covariances=jnp.zeros((0, assets, assets)),
            joined=jnp.zeros(assets, jnp.int32),
            year=jnp.ones(()),
            tradable=None,
            first_decision=jnp.array(0, jnp.int32),
            last_decision=jnp.array(0, jnp.int32),
            allowed=_allowed(settings.get("mandate", ""), np.ones(assets, bool), 1.0),
            **settings,
        )

    def on_rows(self, prices: Prices, first: int = 0) -> "Portfolio":
        """The same task on a table's rows from ``first`` on, with the scale of its observations.

        Signals and anchors look back on the rows before.
        """
        there = ~np.isnan(prices.values[first]) if prices.tradable is None else None
        every = np.ones(len(prices.assets), bool)  # it may learn to hold what it could not before
        task = self.having(allowed=_allowed(self.mandate, every, self.max_weight))
        return task.on(prices).part(first, len(prices) - 1, there)

    def on(self, prices: Prices) -> "Portfolio":
        """The same task on another table, otherwise unchanged."""
        year = prices.periods_per_year
        chosen = signals.parse(self.signals, year)
        logs = np.zeros(prices.values.shape)
        logs[1:] = np.nan_to_num(np.diff(np.log(prices.values), axis=0))
        columns = dict(zip(prices.feature_names, np.moveaxis(prices.features, -1, 0), strict=True))
        computed = signals.compute(
            chosen, prices.known, self.signal_scale, columns, prices.tradable
        )
        extra = np.concatenate([prices.features, computed], -1)
        followed = logs[:0]
        if self.anchor:
            can = buyable(self.mandate) if self.mandate else None
            followed = anchors.path(self.anchor, prices, can)
        then = Conditions.of(prices, self.costs)
        if own_modules(self.costs):
            row = len(prices.dates) - 2
            moves = np.nan_to_num(prices.values[-1] / prices.values[-2], nan=1.0)
            require_sound(self.costs, then.trade(row, 1), moves, then.holding(row, row + 1))
        terms, risk = self.written.trading, self.written.risk
        passed = calendar_years(prices.dates) if terms.turnover_a_year else np.zeros(0)
        compared = anchors.path(risk.benchmark, prices) if risk.benchmark else logs[:0]
        estimated = np.zeros((0, *self.covariances.shape[1:]))
        if self.allowed is not None and self.allowed.limits_risk:
            estimated = covariances(logs, prices.first_rows, risk.rows, year)
        decides = decision_rows(self.calendar, prices.dates) if self.calendar else np.zeros(0, bool)
        decides[-1:] = True  # tomorrow's weights may be asked for on any day
        tradable, patterns = prices.tradable, None
        joined = prices.first_rows.astype(np.int32)
        if tradable is not None and self.allowed is not None:
            # What training did not cover stays closed, also once the first asset has ended.
            low, high = map(np.asarray, self.allowed.limits[:2])
            may = tradable & ((low != 0) | (high != 0))
            patterns = Patterns.of(self.mandate, may, self.max_weight)[0].in_float32()
        numbers = {
            "log_relatives": logs, "extra": extra, "anchors": followed, "conditions": then,
            "elapsed": passed, "benchmarks": compared, "covariances": estimated, "year": year,
        }  # fmt: skip
        others = {
            "joined": joined, "decides": decides, "tradable": tradable, "patterns": patterns,
        }  # fmt: skip
        arrays = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), numbers)
        return self.having(**arrays, **jax.tree.map(jnp.asarray, others))

    def having(self, **arrays: Any) -> "Portfolio":
        """The same task with other arrays in some fields, which are not checked."""
        return eqx.tree_at(
            lambda task: [getattr(task, name) for name in arrays],
            self,
            list(arrays.values()),
            is_leaf=lambda x: x is None,
        )

    def deciding_at(self, row: int) -> "Portfolio":
        """The same task with a decision at a row, whatever the calendar says."""
        if not self.calendar:
            return self
        return self.having(decides=self.decides.at[row].set(True))

    def __check_init__(self) -> None:
        require(self, "window horizon", lambda x: 1 <= x <= 100_000, "from 1 to 100,000")
        require(self, "lag", lambda x: 0 <= x <= 1000, "from 0 to 1000 rows")
        require(self, "max_weight", lambda x: 0 < x <= 1, "above 0 and at most 1")
        require(self, "cost", lambda x: 0 <= x <= 0.2, "from 0 to 0.2")
        require(self, "tracking_aversion", lambda x: 0 <= x <= 1e4, "from 0 to 10,000")
        # Whatever the reward: it may use neither, and folders hold finite numbers only.
        require(self, "risk_aversion sharpe_rate", np.isfinite, "finite")
        _ = decision_rows(self.calendar, np.zeros(0, "datetime64[s]"))
        _ = self.parts  # which check their own settings
        if self.active and not self.anchor:
            raise QfolioError(
                "active=true measures rewards in excess of an anchor's; set an anchor, such as "
                "anchor=equal-weight."
            )
        if self.tracking_aversion and not self.active:
            raise QfolioError(
                "tracking_aversion penalizes rewards in excess of an anchor's; set active=true, or "
                "tracking_aversion=0."
            )
        if self.active and self.path_dependent:
            raise QfolioError(
                f"active compares single steps, and reward={self.reward} depends on earlier ones; "
                "set reward=log, or active=false."
            )

    def part(self, first: int, last: int, tradable: np.ndarray | None = None) -> "Portfolio":
        """The same task on rows ``first`` to ``last`` only, both included.

        Windows, rewards and the scale of observations come from these rows only. tradable: which
        assets may be held, shape (asset,) (default: all). Raises QfolioError if there are too few
        rows, or no asset that may be held.
        """
        decisions = last - self.lag - 1 - (first + self.window) + 1
        if decisions < self.horizon:
            both, alone = "window or horizon (--set horizon=…)", "window (--set window=…)"
            raise TooFewRowsError(
                f"{last - first + 1} rows are too few: a window of {self.window}, a lag of "
                f"{self.lag} and an episode of {self.horizon} need at least "
                f"{self.window + self.lag + self.horizon + 1}; give more rows (a longer --train in "
                f"a backtest), or lower {both if decisions > 0 else alone}."
            )
        rows = slice(first + 1, last + 1)
        usable = np.ones(self.limits.shape[0], bool) if tradable is None else tradable
        there = usable if self.tradable is None else np.asarray(self.tradable)[rows] & usable
        if not there.any():
            raise QfolioError(
                "No asset can be traded over these rows; give rows in which some have prices (and, "
                "with --members, are members)."
            )
        channels = np.concatenate(
            [np.asarray(self.log_relatives)[rows, :, None], np.asarray(self.extra)[rows]], axis=2
        )[:, usable]
        if self.tradable is not None and not there[:, usable].all():
            channels = channels[there[:, usable]][:, None]
        center, scale = _center_and_scale(channels)
        center[0] = 0.0  # returns keep their sign, which is informative
        limits = np.where(usable, self.max_weight, 0.0)
        allowed = _allowed(self.mandate, usable, self.max_weight)
        if allowed is not None:
            limits = np.maximum(allowed.limits.high, 0.0)
        return self.having(
            limits=jnp.asarray(limits, jnp.float32),
            center=jnp.asarray(center, jnp.float32),
            scale=jnp.asarray(scale, jnp.float32),
            first_decision=jnp.array(first + self.window, jnp.int32),
            last_decision=jnp.array(last - self.lag - 1, jnp.int32),
            allowed=allowed,
        )

    @property
    def parts(self) -> list[object]:
        """Cost model, reward, signals and anchor, any of which may be a user's own."""
        anchored = map(baseline, anchors.baselines(self.anchor))
        return [self.costs, self.reward_function, *signals.parse(self.signals), *anchored]

    @property
    def written(self) -> Mandate:
        """The mandate, or one without limits."""
        return parse(self.mandate)[1] if self.mandate else Mandate()

    @property
    def terms(self) -> Terms:
        """When orders are given, and how they are filled."""
        trading, margin = self.written.trading, self.written.exposure.margin
        return Terms(
            self.decides,
            self.elapsed,
            band(self.calendar),
            trading.fill,
            trading.turnover_a_year or np.inf,
            1 / margin if margin else np.inf,
        )

    def filled_at_once(self) -> "Portfolio":
        """The same task with every order filled in one row."""
        if self.terms.fill == 1:
            return self
        assets, mandate = parse(self.mandate)
        trading = msgspec.structs.replace(mandate.trading, fill=1)
        text = msgspec.structs.replace(mandate, trading=trading).text(assets)
        return dataclasses.replace(self, mandate=text)

    def hold(self, weights: Float[Array, " entry"], spent: Any = 0.0) -> Holding:
        """A holding without a history; spent: turnover since the calendar year began."""
        return super().hold(weights)._replace(plan=self.terms.begin(weights, spent))

    def wanted(self, market: Row, holding: Holding, action: Array) -> Float[Array, " entry"]:
        """The weights ordered, as in any market.

        Where debts are allowed, an action may also be the assets' weights; cash is the rest.
        """
        if action.shape == self.limits.shape:
            action = simplex.with_rest(action)
        return super().wanted(market, holding, action)

    def allow(
        self, market: Row, holding: Holding, weights: Float[Array, " entry"]
    ) -> Float[Array, " entry"]:
        """As in any market; what is held where no decision is due."""
        feasible, held = self.feasible_at(market), holding.weights
        if self.tradable is not None:
            weights = universe.spread(weights, self.tradable[market], self.feasible.long_only)
        due = jnp.asarray(self.terms.due(market, held))
        if not isinstance(feasible, Mandated):
            return jnp.where(due, feasible.project(weights, held), held)
        feasible = feasible.spending(self.terms.unspent(holding.plan))
        return feasible.project(weights, held, due)

    def trade(
        self, market: Row, holding: Holding, wanted: Float[Array, " entry"]
    ) -> tuple[Float[Array, " entry"], Plan | None]:
        """The weights to trade to now, and the plan for later rows.

        Nothing new is ordered where no decision is due. An order that is filled over several rows
        is traded in parts.
        """
        terms, held = self.terms, holding.weights
        given = terms.due(market, held) & terms.beyond(held, wanted)
        return terms.trade(held, wanted, given, holding.plan)

    def planned(self, market: Row, plan: Plan | None) -> Plan | None:
        if plan is None:
            return None
        order = self.drifted(market, plan.order)
        if self.tradable is not None:  # the rest of an order drops what may no longer be bought
            order = cashed(order, self.tradable[market + 1])
        return self.terms.next_row(market, plan, order)

    @property
    def actions(self) -> Actions:
        """The allocations of the menu; without one, all weights up to the largest."""
        if self.menu:
            return super().actions
        if not self.feasible.long_only:  # the weights of the assets; cash is the rest
            return Box(self.limits.shape[0], reach(self.mandate, self.max_weight))
        most = largest_weight(self.mandate) if self.mandate else 1.0
        return Simplex(self.limits.shape[0], min(self.max_weight, most))

    @property
    def feasible(self) -> Feasible:
        return super().feasible if self.allowed is None else self.allowed

    def feasible_at(self, market: Row) -> Feasible:
        """The weights that may be ordered at a row, given its tradable assets and risk estimate."""
        allowed = self.allowed
        if allowed is None:
            return CappedSimplex(self._limits(market))
        if self.patterns is not None:
            allowed = self.patterns.at(market, allowed)
        return allowed.knowing(self._past(market)) if allowed.limits_risk else allowed

    def risk_at(self, market: Row) -> Risk:
        """The risk estimated at a row from the returns up to it."""
        return self._past(market).risk

    def _past(self, market: Row) -> Past:
        rows = self.written.risk.rows
        return Past(
            self.log_relatives,
            self.joined,
            self.covariances,
            self.benchmarks,
            market,
            self.year,
            rows,
        )

    def _limits(self, market: Row) -> Float[Array, " asset"]:
        """The largest weights at a row."""
        if self.tradable is None:
            return self.limits
        there = lax.dynamic_index_in_dim(self.tradable, market, keepdims=False)
        return jnp.where(there, self.limits, 0.0)

    def draw_reachable(self, market: Row, key: PRNGKeyArray) -> Holding:
        """A random holding, with turnover spent up to the elapsed share of the year's maximum."""
        drawn = super().draw_reachable(market, key)
        if drawn.plan is not None and self.elapsed.shape[0]:
            pace = self.terms.turnover * (self.elapsed[market] % 1)
            spent = pace * jax.random.uniform(apart(key))
            drawn = self.hold(drawn.weights, spent)
        if self.tradable is None:
            return drawn
        there = lax.dynamic_index_in_dim(self.tradable, market, keepdims=False)
        return drawn._replace(weights=cashed(drawn.weights, there))

    def reset_market(self, key: PRNGKeyArray) -> Row:
        starts = self.last_decision - self.first_decision + 1 - self.horizon + 1
        drawn = jnp.floor(jax.random.uniform(key) * starts).astype(jnp.int32)
        return self.first_decision + drawn

    def next_market(self, market: Row, key: PRNGKeyArray) -> Row:
        # One row later the last decision's outcome is known; episodes end there at the latest.
        return jnp.minimum(market + 1, self.last_decision + 1)

    def steps_left(self, state: Position) -> Int[Array, ""]:
        return self.last_decision + 1 - state.market

    def features(self, market: Row) -> Float[Array, "asset time channel"]:
        start = market - self.window + 1
        returns = lax.dynamic_slice_in_dim(self.log_relatives, start, self.window)
        others = lax.dynamic_slice_in_dim(self.extra, start, self.window)
        # Scaled and transposed before they are joined: an agent that reads only signals then
        # computes only them, and XLA copies nothing to leave the returns out.
        returns = self.scaled(returns[..., None], slice(1))
        others = self.scaled(others, slice(1, None))
        return jnp.concatenate([jnp.swapaxes(returns, 0, 1), jnp.swapaxes(others, 0, 1)], -1)

    def scaled(
        self, values: Float[Array, "*shape part"], which: slice = slice(None)
    ) -> Float[Array, "*shape part"]:
        """Channels, or a part of them, as agents observe them: 0, the mean, where unknown."""
        # Multiplied, because XLA divides or multiplies by the reciprocal, depending on how many
        # folds share a program, and these round differently.
        factor = 1 / self.scale
        moved = (values - self.center[which]) * factor[which]
        return jnp.where(jnp.isnan(moved), 0.0, moved)

    def anchor_weights(self, market: Row) -> Float[Array, " asset"] | None:
        """The anchor's weights; those of assets that cannot be traded go to the others.

        An asset that can be traded has at least ``LEAST`` times an equal share of the anchor, so
        that a weight of 0 marks an asset that cannot, unless the whole anchor is cash.
        """
        if not self.anchor:
            return None
        weights = lax.dynamic_index_in_dim(self.anchors, market, keepdims=False)
        limits = self._limits(market)
        open_to = limits > 0
        kept = jnp.where(open_to, weights, 0.0)
        share = kept / jnp.maximum(kept.sum(), 1e-9)
        share = (1 - LEAST) * share + LEAST * open_to / jnp.maximum(open_to.sum(), 1)
        return jnp.minimum(weights.sum() * share, limits)

    @property
    def tilting(self) -> int:
        return len(signals.parse(self.signals))

    def signalled(self, market: Row) -> Signalled | None:
        """The anchor (equal weights if there is none) and unscaled signals, 0 where unknown."""
        if not self.tilting:
            return None
        anchor = self.anchor_weights(market)
        if anchor is None:
            limits = self._limits(market)
            open_to = limits > 0
            anchor = jnp.minimum(open_to / jnp.maximum(open_to.sum(), 1), limits)
        others = lax.dynamic_index_in_dim(self.extra, market, keepdims=False)
        return Signalled(anchor, jnp.nan_to_num(others[:, others.shape[1] - self.tilting :]))

    @property
    def moves(self) -> Float[Array, ""]:
        return self.last_decision - self.first_decision + 1.0

    def place(self, market: Row) -> Float[Array, ""]:
        return 1.0 * (market - self.first_decision)

    def settle(
        self, market: Row, next_market: Row, holding: Holding, action: Array
    ) -> tuple[Float[Array, ""], Holding]:
        reward, after = super().settle(market, next_market, holding, action)
        return self.compared(market, next_market, reward), after

    def compared(self, market: Row, next_market: Row, reward: Float[Array, ""]) -> Float[Array, ""]:
        """A reward; ``active`` subtracts that of holding the anchor, free of cost.

        What is subtracted depends on the market alone, so that the best policy stays the same and
        noise that all policies share is removed (input-dependent baselines, Mao et al. 2019).
        ``tracking_aversion`` penalizes tracking error: the mean square of active rewards is nearly
        their variance.
        """
        if self.active:
            shared = self.reference(market, next_market)
            assert shared is not None  # there is an anchor
            reward -= shared
            reward -= self.tracking_aversion / 2 * reward**2
        return reward

    def relatives(self, market: Row, next_market: Row) -> Relatives:
        # Rows up to market + lag + 1 exist for every decision that is settled.
        after = lax.dynamic_slice_in_dim(self.log_relatives, market + 1, self.lag + 1)
        return Relatives(
            waiting=jnp.exp(after[: self.lag].sum(0)),
            earning=jnp.exp(after[self.lag]),
            coming=jnp.exp(after[0]),
        )

    def contexts(self, market: Row, next_market: Row) -> Contexts:
        executed, then = market + self.lag, self.conditions
        return Contexts(
            waiting=then.holding(market, executed),
            trade=then.trade(executed, self.lag),
            earning=then.holding(executed, executed + 1),
            coming=then.holding(market, market + 1),
        )

    def drifted(self, row: Row, weights: Float[Array, " entry"]) -> Float[Array, " entry"]:
        """Weights held at a row, drifted to the next row without a trade."""
        last = self.log_relatives.shape[0] - 1
        period = self.conditions.holding(row, jnp.minimum(row + 1, last))
        return self.costs.held(weights, self.coming(row), period)

    def coming(self, row: Row) -> Float[Array, " asset"]:
        """Price relatives from a row to the next; 1 after the table's last row."""
        rows = self.log_relatives.shape[0]
        following = lax.dynamic_index_in_dim(self.log_relatives, row + 1, keepdims=False)
        return jnp.where(row + 1 < rows, jnp.exp(following), 1.0)


def _center_and_scale(channels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mean and the deviation of each channel, with its mean where it is unknown.

    channels: of shape (row, asset, channel), NaN where unknown.
    """
    unknown = np.isnan(channels)
    with warnings.catch_warnings(action="ignore"):  # of channels that are unknown in all rows
        center = np.nan_to_num(np.nanmean(channels, (0, 1)))
    scale = np.where(unknown, center, channels).std((0, 1))
    rare = unknown.mean((0, 1)) > RARE
    varied = np.where(scale > CONSTANT * abs(center), scale, 1.0)
    return center, np.where(rare, np.maximum(scale, 1.0), varied)


def _allowed(mandate: str, usable: np.ndarray, most: float) -> Mandated | None:
    """The weights that a mandate allows over some rows, in float32; None without a mandate."""
    if not mandate:
        return None
    made, _ = checks.relaxed(feasible(mandate, usable, most))
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), made)
