"""Whether a mandate can be met: which limits clash, and what is unusual about the others."""

import dataclasses
from collections.abc import Collection, Iterable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from qfolio.core.errors import QfolioError
from qfolio.core.text import amount, listed, near, quote
from qfolio.portfolio.mandate.feasible import Mandated
from qfolio.portfolio.mandate.limits import feasible, parse
from qfolio.portfolio.mandate.projection import Limits
from qfolio.portfolio.mandate.risk import Risk

TINY = 1e-7

CLEARLY = 1.05
"""Least risk up to this multiple of a limit counts as met."""

GAP, VERTICES = 0.01, 200
"""The least risk is known to within this share, unless that takes more vertices."""


def require(text: str, usable: Bool[np.ndarray, " asset"], most: float = 1.0) -> None:
    """Raises QfolioError if no weights obey a mandate; arguments as for ``limits.feasible``.

    The message names limits that clash: without any one of them, the others could be met. Or it
    names an asset of a group that the table does not have.
    """
    made = feasible(text, usable, most)
    _require_members(text)
    if not (made.limits.low.any() or made.limits.high.any()):
        raise QfolioError(
            "The mandate cannot be met: it allows no weight in any asset; change assets.forbidden "
            "or assets.cap."
        )
    _require_each(text, made.limits, made.long_only)
    said = _said(text, made, most)
    clash = list(range(len(said)))
    if _found(made.limits, clash) is None:
        for i in range(len(said)):
            rest = [other for other in clash if other != i]
            if _found(made.limits, rest) is None:
                clash = rest
        if len(clash) == 1:
            raise QfolioError(f"The mandate cannot be met: no weights have {said[clash[0]]}.")
        both = " and ".join(said[i] for i in clash)
        raise QfolioError(f"The mandate cannot be met: {both} clash; change one of them.")
    cash, margin = parse(text)[1].cash, parse(text)[1].exposure.margin
    if margin and made.gross * margin > 1 + TINY:
        raise QfolioError(
            f"The mandate cannot be met: orders with a gross exposure of {_percent(made.gross)} "
            f"would break a margin of {_percent(margin)}, which allows {_percent(1 / margin)}; set "
            "exposure.gross below that, or lower the margin."
        )
    left = 1 - _most_held(made)
    if left > cash.max + TINY:
        at = "at its cap leaves" if made.holdings == 1 else "at their caps leave"
        raise QfolioError(
            f"The mandate cannot be met: {amount(made.holdings, 'holding')} {at} "
            f"{_percent(left)} in cash, and cash is at most {_percent(cash.max)}; change one of "
            "them."
        )
    forced = int(((made.limits.low > 0) | (made.limits.high < 0)).sum())
    if made.holdings and forced > made.holdings:
        raise QfolioError(
            f"The mandate cannot be met: {forced} assets have a floor above 0 or a cap below, and "
            f"trading.holdings is {made.holdings}; change one of them."
        )


def unusual(text: str, usable: Bool[np.ndarray, " asset"], most: float = 1.0) -> list[str]:
    """What is unusual about caps, or about a mandate that can be met, a sentence each.

    Arguments are as for ``limits.feasible``; the text is empty without a mandate.
    """
    if not text:
        count = int(usable.sum())
        left = 1 - most * count
        said = f"The cap of {_percent(most)} for each of {count} assets"
        return [f"{said} forces at least {_percent(left)} cash."] if left > TINY else []
    made, notes = feasible(text, usable, most), _misspelt(text)
    limits = made.limits
    equal = 1 / int(usable.sum())
    if made.smallest_trade > equal:
        notes.append(
            f"The smallest trade, {_percent(made.smallest_trade)}, is more than an equal weight, "
            f"{_percent(equal)}, so that many orders are not carried out."
        )
    left = 1 - _most_held(made)
    if left > max(parse(text)[1].cash.min, 0.0) + TINY:
        notes.append(f"The mandate forces at least {_percent(left)} cash: caps allow no more.")
    for (what, side), row, bound in zip(made.bounds, limits.rows, limits.most, strict=True):
        if side == "floor" and row.any():
            found = _found(limits, value=-row)
            assert found is not None
            count = limits.low.size
            if -row @ (found[:count] - found[count : 2 * count]) <= -bound + TINY:
                notes.append(
                    f"The mandate leaves no choice for {what}: its floor, {_percent(-bound)}, is "
                    "also the most that the other limits allow."
                )
    return notes


def require_safe(text: str, starts: Iterable[Mandated], most: float = 1.0) -> None:
    """Raises QfolioError if a limit on risk can be met at none of some rows.

    text, most: as for ``limits.feasible``. starts: the sets at these rows, which know their risk.
    Turnover and the number of holdings do not count, and each limit on risk counts by itself: with
    them there may be even more risk.
    """
    _, mandate = parse(text)
    risk, forbidden = mandate.risk, mandate.assets.forbidden
    given = {"volatility": risk.volatility, "tracking error": risk.tracking_error}
    limits = {name: limit for name, limit in given.items() if limit is not None}
    never: dict[str, tuple[float, Mandated | None]] = dict.fromkeys(limits, (np.inf, None))
    for made in starts if limits else ():
        for name, (lowest, _) in list(never.items()):
            least = _least_risk(made, name, CLEARLY * limits[name])
            if least <= CLEARLY * limits[name]:
                del never[name]
            elif least < lowest:
                never[name] = least, made
        if not never:
            return
    for name, (least, safest) in never.items():
        assert safest is not None  # there is a first row
        allowed, said = CLEARLY * limits[name], _said(text, safest, most)
        clash = list(range(len(said)))
        for i in range(len(said)):
            rest = [other for other in clash if other != i]
            if _least_risk(safest, name, allowed, rest) > allowed:
                clash = rest
        forced = [said[i] for i in clash] or ["assets.forbidden"][: len(forbidden)]
        force = f", with {listed(forced)}" if forced else ""
        raise QfolioError(
            f"The mandate cannot be met: {name} is at least {100 * least:.3g}% at the start of "
            f"every fold{force}, and risk.{name.replace(' ', '_')} is {_percent(limits[name])}; "
            f"{'change one of them' if forced else 'raise it'}."
        )


def _least_risk(
    made: Mandated, kind: str, enough: float, kept: Collection[int] | None = None
) -> float:
    """A lower bound of volatility or tracking error within the limits, to within ``GAP``.

    enough: a risk up to which it is not lowered further. kept: as for ``_found``. The least risk of
    a mix of vertices is found exactly, and the vertex that lowers it most joins them (simplicial
    decomposition, von Hohenbalken 1977).
    """
    from scipy.optimize import nnls

    assert isinstance(made.risk, Risk)
    covariance = np.asarray(made.risk.covariance, float)
    center = np.asarray(made.risk.benchmark, float) if kind == "tracking error" else 0.0
    values, vectors = np.linalg.eigh(covariance)
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    count, slope = len(covariance), np.zeros(len(covariance))
    vertices: list[np.ndarray] = []
    risk = least = 0.0
    for _ in range(VERTICES):
        found = _found(made.limits, kept, value=-slope)
        assert found is not None  # the set is not empty
        vertex = found[:count] - found[count : 2 * count] - center
        if vertices and (least := float(slope @ vertex) / risk) >= (1 - GAP) * risk:
            break
        vertices.append(vertex)
        mixed = np.array(vertices).T
        table = np.vstack([root @ mixed, np.ones(len(vertices))])
        shares = nnls(table, np.append(np.zeros(count), 1.0), maxiter=10_000)[0]
        weights = mixed @ (shares / shares.sum())
        risk, slope = float(np.linalg.norm(root @ weights)), covariance @ weights
        if risk <= enough:
            return risk
    return least


def relaxed(made: Mandated) -> tuple[Mandated, list[str]]:
    """The same set with lower floors where they cannot be met, and what was lowered, in words.

    For folds and rows in which some assets cannot be traded. What is taken off the floors (and
    added to the maximum of cash) is the least in sum.
    """
    limits, count = made.limits, made.limits.low.size
    falls, short = limits.rows.min(1) < 0, np.zeros(len(limits.most))
    if made.holdings:  # so few may not reach a floor
        reached = np.sort(limits.rows * limits.high)[:, : made.holdings].sum(1)
        short = np.where(falls, np.maximum(reached - limits.most, 0.0), 0.0)
        limits = limits._replace(most=limits.most + short)
    if _found(limits) is not None and not (short > TINY).any():
        return made, []
    found = _found(limits, slack=falls)
    if found is None:
        raise QfolioError(
            "The mandate cannot be met with the assets that can be traded; relax its caps, or drop "
            "the assets that start late."
        )
    extra = short + found[2 * count :]
    extra = np.where(extra > TINY, extra + TINY, 0.0)
    eased = made.limits._replace(most=made.limits.most + extra)
    lowered = [f"{bound.what} by {_percent(more)}"
               for bound, more in zip(made.bounds, extra, strict=True) if more > 0]  # fmt: skip
    return dataclasses.replace(made, limits=eased), lowered


def _found(
    limits: Limits,
    kept: Collection[int] | None = None,
    *,
    value: Any = 0.0,
    slack: Any = False,
) -> Float[np.ndarray, " number"] | None:
    """Long positions, short ones, and what rows are exceeded by; None if the limits cannot be met.

    kept: the limits to obey, numbered as in ``_said`` (default: all). value: what a weight is worth
    in the sum to maximize, which what rows are exceeded by counts against. slack: the rows that may
    be exceeded.
    """
    from scipy.optimize import linprog

    count, rows = limits.low.size, limits.most.size
    keep = range(rows + 3) if kept is None else kept
    high = limits.high if 0 in keep else np.where(limits.high > 0, 10.0, limits.high)
    low = limits.low if 1 in keep else np.where(limits.low < 0, -10.0, 0.0)
    table = np.vstack([limits.rows, np.ones((1, count))])
    other = np.vstack([-limits.rows, np.ones((1, count))])
    both = np.hstack([table, other, -np.eye(rows + 1, rows)])
    most = np.append(limits.most, limits.gross)
    chosen = [i for i in range(rows + 1) if i + 2 in keep and np.isfinite(most[i])]
    worth = np.broadcast_to(value, count)
    bounds = [
        *zip(np.maximum(low, 0.0), np.maximum(high, 0.0), strict=True),
        *zip(np.maximum(-high, 0.0), np.maximum(-low, 0.0), strict=True),
        *((0.0, None if yes else 0.0) for yes in np.broadcast_to(slack, rows)),
    ]
    solved = linprog(
        np.concatenate([-worth, worth, np.ones(rows)]),
        both[chosen] if chosen else None,
        most[chosen] + 1e-9 if chosen else None,
        bounds=bounds,
    )
    return np.asarray(solved.x) if solved.success else None


def _most_held(made: Mandated) -> float:
    """The largest sum of weights that the limits allow."""
    limits = made.limits
    found = _found(limits, value=1.0)
    assert found is not None  # they can be met
    held = found[: limits.low.size].sum() - found[limits.low.size : 2 * limits.low.size].sum()
    if made.holdings:
        held = min(held, np.sort(limits.high)[::-1][: made.holdings].sum())
    return float(held)


def _require_members(text: str) -> None:
    assets, mandate = parse(text)
    for column, value, group in mandate.every_group:
        for name in () if group.ignore_unknown else group.assets:
            if name not in assets:
                raise QfolioError(
                    f"The mandate's group {column} {value} names {quote(name)}, which is no asset "
                    f"of the table; {near(name, assets)}"
                )


def _misspelt(text: str) -> list[str]:
    """Notes on assets that a file of groups seems to name in another spelling."""
    assets, mandate = parse(text)
    notes = []
    for column, values in mandate.groups.items():
        named = {name for group in values.values() if group.ignore_unknown for name in group.assets}
        unknown = {_letters(name): name for name in named - set(assets)}
        for asset in assets:
            if asset not in named and (other := unknown.get(_letters(asset))):
                notes.append(
                    f"{asset} has no {column} in the mandate's file of groups, which names "
                    f"{other}: no limit of a group applies to {asset}."
                )
    return notes


def _letters(name: str) -> str:
    """A name without case, spaces and signs: BRK.B is brk-b."""
    return "".join(filter(str.isalnum, name.casefold()))


def _require_each(text: str, limits: Limits, long_only: bool) -> None:
    assets, mandate = parse(text)
    signed = (("floor", mandate.assets.floor, 1), ("cap", mandate.assets.cap, -1))
    caps = mandate.assets.cap
    for name, most in (caps if isinstance(caps, dict) else {"each asset": caps}).items():
        if most > 1 and long_only:
            raise QfolioError(
                f"The cap of {name}, {_percent(most)}, is above 100%, which only a mandate with "
                "loans or short sales allows; write 0.2 for 20%."
            )
    for name in mandate.assets.forbidden:
        for said, of_each, sign in signed:
            bound = of_each.get(name, 0.0) if isinstance(of_each, dict) else 0.0
            if sign * bound > 0:
                raise QfolioError(
                    f"The mandate cannot be met: the {said} of {name}, {_percent(bound)}, and "
                    f"assets.forbidden, which names {name}, clash; change one of them."
                )
    for name, low, high in zip(assets, limits.low, limits.high, strict=True):
        if low > high:
            raise QfolioError(
                f"The mandate cannot be met: the floor of {name}, {_percent(low)}, is above its "
                f"cap, {_percent(high)}; change one of them."
            )
    pairs: list[tuple[str, float | None, float | None]] = [
        ("cash", mandate.cash.min, mandate.cash.max)
    ]
    pairs += [(f"{c} {v}", group.floor, group.cap) for c, v, group in mandate.every_group]
    for name, floor, cap in pairs:
        if floor is not None and cap is not None and floor > cap:
            raise QfolioError(
                f"The mandate cannot be met: the minimum of {name}, {_percent(floor)}, is above "
                f"its maximum, {_percent(cap)}; change one of them."
            )


def _said(text: str, made: Mandated, most: float) -> list[str]:
    """The limits in words: caps and floors of assets, then the rows, then gross exposure."""
    _, mandate = parse(text)
    said = [f"the caps of assets{_spelled(mandate.assets.cap, most if most < 1 else np.inf)}"]
    said.append(f"the floors of assets{_spelled(mandate.assets.floor)}")
    for (what, side), bound in zip(made.bounds, made.limits.most, strict=True):
        least = side in ("minimum", "floor")
        share = {"minimum": 1 - bound, "maximum": 1 + bound, "floor": -bound, "cap": bound}[side]
        said.append(f"{what} of at {'least' if least else 'most'} {_percent(share)}")
    return [*said, f"gross exposure of at most {_percent(float(made.limits.gross))}"]


def _spelled(given: float | dict[str, float], most: float = np.inf) -> str:
    return "" if isinstance(given, dict) else f" ({_percent(min(given, most))})"


def _percent(share: float) -> str:
    return f"{100 * round(share, 9):.6g}%"
