"""A mandate: the limits that every order obeys, its calendar and its costs, as a file says them.

    benchmark = "SPY"

    [assets]                  # cap and floor: a number for all, or a table with some assets
    cap = 0.2
    floor = { SPY = 0.05 }
    forbidden = ["USO"]

    [groups]                  # a table with the columns asset, sector, …
    file = "groups.csv"
    [groups.sector.Energy]
    cap = 0.2

    [cash]
    max = 0.05

    [risk]                    # a year
    tracking_error = 0.04
    volatility = 0.12

    [trading]                 # of one decision
    turnover = 0.3
    turnover_a_year = 2.0
    fill = 5
    smallest_trade = 0.005
    holdings = 10
    lot = 100
    calendar = "monthly"

    [costs]                   # of the cost model "itemized"
    minimum = 1.0
    cash_rate = 0.03

docs/guides/mandate.md describes every key. ``limits.py`` makes arrays of the limits, and
``checks.py`` says whether they can be met.
"""

import csv
import json
import re
import reprlib
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec

from qfolio.core.errors import QfolioError, require_type
from qfolio.core.registry import BASELINES
from qfolio.core.text import listed, near, quote

Weight = Annotated[float, msgspec.Meta(ge=-3, le=3)]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
Lot = Annotated[float, msgspec.Meta(gt=0, le=1e9)]
Turnover = Annotated[float, msgspec.Meta(gt=0, le=1000)]


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A part of a mandate."""


class Assets(Section, frozen=True):
    """Limits of single assets; a floor below 0 allows to sell short."""

    cap: Weight | dict[str, Weight] = 1.0
    floor: Weight | dict[str, Weight] = 0.0
    forbidden: tuple[str, ...] = ()


class Group(Section, frozen=True):
    """Limits of the sum of some assets' weights.

    ignore_unknown: whether it may name assets that a table does not have, as a file of groups may.
    """

    cap: Weight | None = None
    floor: Weight | None = None
    assets: tuple[str, ...] = ()
    ignore_unknown: bool = False


class Cash(Section, frozen=True):
    """The range of cash, which is 1 less the net exposure."""

    min: Weight = 0.0
    max: Weight = 1.0


class Trading(Section, frozen=True):
    """Limits of a decision. turnover: the sum of all changes of weights, bought and sold.

    turnover_a_year: the same sum over a calendar year. calendar: as ``calendars.decision_rows``
    takes it. fill: rows over which an order is filled, in equal parts. lot: shares that are traded
    together, a number for all assets or for some; allocation alone knows shares, and rounds to
    them.
    """

    calendar: str = ""
    turnover: Turnover | None = None
    turnover_a_year: Turnover | None = None
    fill: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 1
    smallest_trade: Share = 0.0
    holdings: Annotated[int, msgspec.Meta(ge=1, le=100_000)] | None = None
    lot: Lot | dict[str, Lot] | None = None


class Exposure(Section, frozen=True):
    """gross: the largest sum of absolute weights.

    margin: the least share of that sum which the account's own wealth must be. If prices bring it
    below, a decision is due at that row, whatever the calendar says.
    """

    gross: Annotated[float, msgspec.Meta(gt=0, le=20)] | None = None
    margin: Annotated[float, msgspec.Meta(gt=0, le=1)] | None = None


class RiskLimits(Section, frozen=True):
    """Limits on the risk of an order, a year, as the last ``rows`` returns show it.

    benchmark: what tracking error is measured against: an asset, a baseline, or feature:NAME with
    its weights (default: the mandate's benchmark, or that of the backtest, or equal weights).
    """

    volatility: Annotated[float, msgspec.Meta(gt=0, le=10)] | None = None
    tracking_error: Annotated[float, msgspec.Meta(gt=0, le=10)] | None = None
    benchmark: str | None = None
    rows: Annotated[int, msgspec.Meta(ge=20, le=10_000)] = 252


class Mandate(Section, frozen=True):
    """Limits on weights, and terms of trade; each section is optional.

    groups: by column and value. costs: settings of the cost model "itemized", or of another one
    that the key "model" names. benchmark: what all strategies are compared with.
    """

    benchmark: str | None = None
    costs: dict[str, str | float] = {}
    assets: Assets = Assets()
    groups: dict[str, dict[str, Group]] = {}
    cash: Cash = Cash()
    trading: Trading = Trading()
    exposure: Exposure = Exposure()
    risk: RiskLimits = RiskLimits()

    @staticmethod
    def read(path: Path | str, limits: Sequence[str] = ()) -> "Mandate":
        """The mandate in a file, with other values of some keys, as ``changed`` takes them.

        Raises QfolioError if there is none, or one that is wrong.
        """
        path = Path(path)
        try:
            content = tomllib.loads(path.read_text("utf-8-sig"))
        except OSError as error:
            raise QfolioError(f"The mandate {path} cannot be read: {error.strerror}.") from None
        except UnicodeDecodeError:
            raise QfolioError(
                f"The mandate {path} is not UTF-8 text; write it as TOML, see "
                "docs/guides/mandate.md."
            ) from None
        except tomllib.TOMLDecodeError as error:
            raise QfolioError(
                f"{path} is not valid TOML: {error}; see docs/guides/mandate.md."
            ) from None
        groups = content.get("groups")
        if isinstance(groups, dict) and isinstance(groups.get("file"), str):
            groups["file"] = str(path.parent / groups["file"])
        mandate = _made(content, str(path))
        return _made(_assigned(content, limits), "--limits") if limits else mandate

    @staticmethod
    def of(given: "Mandate | Path | str | dict[str, Any]") -> "Mandate":
        """A mandate, from one, from the path of a file, or from a dictionary of its sections."""
        kinds = (Mandate, Path, str, dict)
        require_type("mandate", given, kinds, "a path, or a dictionary of the file's sections")
        if isinstance(given, Mandate):
            return given
        return _made(given, "mandate") if isinstance(given, dict) else Mandate.read(given)

    def changed(self, assignments: Sequence[str]) -> "Mandate":
        """The mandate with other values of some keys, such as "trading.turnover=0.3".

        Keys and values are those of the file; text needs no quotes. Raises QfolioError for a key
        that does not exist, or a value that does not fit.
        """
        return _made(_assigned(msgspec.to_builtins(self), assignments), "--limits")

    @property
    def cost_model(self) -> str:
        """The cost model with its settings, as a market takes it; empty if there is none."""
        if not self.costs:
            return ""
        chosen = ", ".join(f"{k}={v}" for k, v in self.costs.items() if k != "model")
        return f"{self.bare_cost_model}({chosen})"

    @property
    def bare_cost_model(self) -> str:
        """The name of the cost model, without settings."""
        return str(self.costs.get("model", "itemized"))

    def text(self, assets: Sequence[str]) -> str:
        """The limits for a table's assets, in order, as JSON; ``limits.feasible`` takes it.

        Raises QfolioError if it names an asset that the table does not have.
        """
        named = {
            "assets.cap": _named(self.assets.cap),
            "assets.floor": _named(self.assets.floor),
            "assets.forbidden": self.assets.forbidden,
            "trading.lot": _named(self.trading.lot),
        }
        for place, names in named.items():
            for name in names:
                if name not in assets:
                    raise QfolioError(
                        f"{place} of the mandate names {quote(name)}, which is no asset of the "
                        f"table; {near(name, assets)}"
                    )
        for column, value, group in self.every_group:
            if not set(group.assets) & set(assets):
                raise QfolioError(
                    f"The mandate's group {column} {value} has none of the table's assets; name "
                    "them in groups.file, or in the group's assets."
                )
        trading, risk = msgspec.structs.replace(self.trading, calendar=""), self.risk
        against = risk.benchmark or self.benchmark or "equal-weight"
        tracked = risk.tracking_error is not None
        if tracked and against not in {*assets, *BASELINES} and ":" not in against:
            raise QfolioError(
                f"The mandate's tracking error has the benchmark {quote(against)}, which is no "
                "asset of the table and no baseline; set risk.benchmark to one, or to feature:NAME "
                "with its weights."
            )
        risk = msgspec.structs.replace(risk, benchmark=against if tracked else None)
        limits = msgspec.structs.replace(self, benchmark=None, costs={}, trading=trading, risk=risk)
        return msgspec.json.encode((list(assets), limits)).decode()

    @property
    def every_group(self) -> list[tuple[str, str, Group]]:
        """Column, value and limits of each group."""
        return [(c, v, group) for c, values in self.groups.items() for v, group in values.items()]


def _named(given: float | dict[str, float] | None) -> Sequence[str]:
    return list(given) if isinstance(given, dict) else []


def _made(content: Any, source: str) -> Mandate:
    """The mandate in a dictionary, with the assets of groups from its CSV, if it names one."""
    content = _plain(content)
    groups = content.get("groups") if isinstance(content, dict) else None
    if not (isinstance(groups, dict) and "file" in groups):
        return _converted(content, source)
    if not isinstance(groups["file"], str):
        raise QfolioError(f"{source}: groups.file must be the name of a CSV file.")
    others = {column: values for column, values in groups.items() if column != "file"}
    mandate = _converted(content | {"groups": others}, source)
    return _with_members(mandate, Path(groups["file"]), source)


def _assigned(content: dict[str, Any], assignments: Sequence[str]) -> dict[str, Any]:
    """The dictionary of a mandate, in which the values of some keys are replaced."""
    for assignment in assignments:
        key, equals, value = assignment.partition("=")
        try:
            read = tomllib.loads(f"{key} = {value}")
        except tomllib.TOMLDecodeError:
            try:
                read = tomllib.loads(f"{key} = {json.dumps(value.strip())}")
            except tomllib.TOMLDecodeError:
                equals = ""
        if not equals:
            raise QfolioError(
                f"--limits has {quote(assignment)}; it must be a key and a value of a mandate, "
                "such as trading.turnover=0.3."
            )
        _merge(content, read, key.strip())
    return content


def _plain(content: Any) -> Any:
    """The content with Python's numbers and lists in place of numpy's."""
    if isinstance(content, dict):
        return {key: _plain(value) for key, value in content.items()}
    return content.tolist() if hasattr(content, "tolist") else content


def _converted(content: Any, source: str) -> Mandate:
    """The mandate in a dictionary; source: where it comes from, for the message."""
    trading = content.get("trading") if isinstance(content, dict) else None
    if isinstance(trading, dict) and type(trading.get("calendar")) is int:  # every so many rows
        content = content | {"trading": trading | {"calendar": str(trading["calendar"])}}
    try:
        return msgspec.convert(content, Mandate)
    except msgspec.ValidationError as error:
        text, _, at = str(error).replace("`", "").partition(" - at ")
        kind, _, place = at.partition("$")
        key, value = _culprit(content, place, str(error))
        if unknown := re.fullmatch(r"Object contains unknown field (.+)", text):
            known = _fields(key)
            inside = f"[{key}]" if key else "the mandate"
            raise QfolioError(
                f"{source}: {inside} has no key {quote(unknown[1])}; {near(unknown[1], known)}"
            ) from None
        key = key or "the mandate"
        if kind == "key in ":  # from Python, whose dictionaries may have other keys than text
            key, value = f"a key in {key}", next(x for x in value if not isinstance(x, str))
        wanted = _wanted(text)
        if wanted == "a list":  # on the command line, its quotes need some around them
            example = '["USO"]'
            example = f"'{key}={example}'" if source == "--limits" else example
            wanted += f", such as {example}"
        raise QfolioError(
            f"{source}: {key} is {reprlib.repr(value)}; it must be {wanted} (see "
            "docs/guides/mandate.md)."
        ) from None


_KINDS = {"float": "a number", "int": "a whole number", "str": "text", "bool": "true or false",
          "array": "a list", "object": "a table of keys and values"}  # fmt: skip
_BOUNDS = {"<=": "at most", ">=": "at least", "<": "below", ">": "above"}


def _wanted(text: str) -> str:
    """What a value must be, by msgspec's text, such as "Expected float | null, got str"."""
    if bound := re.fullmatch(r"Expected \w+ ([<>]=?) (.+)", text):
        return f"{_BOUNDS[bound[1]]} {float(bound[2]):g}"
    kinds = text.removeprefix("Expected ").partition(",")[0].split(" | ")
    return listed([_KINDS.get(kind, kind) for kind in kinds if kind != "null"], "or")


def _culprit(content: Any, place: str, said: str) -> tuple[str, Any]:
    """The full key of a wrong value, and the value.

    place: the key in msgspec's words, which has [...] for any key of a dictionary. said: all of
    msgspec's words; the key is the one that leads to them without the dictionary's other keys.
    """
    names: list[Any] = []
    value = content
    for part in re.findall(r"\w+|\.\.\.", place):
        if part == "...":
            name = next(each for each in value if _refusal(_only(content, names, each)) == said)
        else:
            name = int(part) if isinstance(value, Sequence) else part
        names.append(name)
        value = value[name]
    return ".".join(map(str, names)), value


def _only(content: dict[str, Any], names: list[Any], name: str) -> dict[str, Any]:
    """The dictionary, in which the one at ``names`` has no key but ``name``."""
    if not names:
        return {name: content[name]}
    return content | {names[0]: _only(content[names[0]], names[1:], name)}


def _refusal(content: dict[str, Any]) -> str:
    """What msgspec says of a dictionary that is no mandate."""
    try:
        msgspec.convert(content, Mandate)
    except msgspec.ValidationError as error:
        return str(error)
    return ""


def _merge(content: dict[str, Any], others: dict[str, Any], place: str, within: str = "") -> None:
    """Puts values into a dictionary of dictionaries, in place.

    place: the key that is assigned. within: the keys of the dictionary, each with a dot behind it.
    Raises QfolioError if a number for one asset would replace one for all.
    """
    for key, value in others.items():
        old, here = content.get(key), within + key
        if isinstance(value, dict) and isinstance(old, dict):
            _merge(old, value, place, f"{here}.")
        elif isinstance(value, dict) and type(old) in (int, float) and here != place:
            raise QfolioError(
                f"--limits sets {place}, but the mandate has a {key} of {old:g} for all assets, "
                f"which the others would lose; write {here}={{A = 0.1, B = 0.2}} with all assets "
                "that have one."
            )
        else:
            content[key] = value


def _fields(place: str) -> list[str]:
    """The keys of a section."""
    section = place.partition(".")[0].partition("[")[0]
    kinds: dict[str, Any] = {"": Mandate, "assets": Assets, "groups": Group, "cash": Cash}
    kinds |= {"trading": Trading, "exposure": Exposure, "risk": RiskLimits}
    return list(kinds[section].__struct_fields__)


def _with_members(mandate: Mandate, file: Path, source: str) -> Mandate:
    """The mandate, with the assets of each group that names none as a CSV says."""
    try:
        with file.open(encoding="utf-8-sig", newline="") as lines:
            table = list(csv.DictReader(lines))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise QfolioError(f"{source}: groups.file {file} cannot be read: {why}.") from None
    columns = list(table[0]) if table else []
    if "asset" not in columns or len(columns) < 2:
        raise QfolioError(
            f"{source}: groups.file {file} must have a column asset and one for each kind of "
            "group, such as sector."
        )
    groups: dict[str, dict[str, Group]] = {}
    for column, value, group in mandate.every_group:
        if group.assets:
            groups.setdefault(column, {})[value] = group
            continue
        if column not in columns:
            raise QfolioError(
                f"{source}: [groups.{column}] is no column of {file}, and [groups.{column}."
                f"{value}] lists no assets; {near(column, columns[1:])}"
            )
        named = (_cell(row, "asset") for row in table if _cell(row, column) == value)
        members = tuple(filter(None, named))
        if not members:
            values = sorted({_cell(row, column) for row in table})
            raise QfolioError(
                f"{source}: no asset of {file} has the {column} {quote(value)}; "
                f"{near(value, values)}"
            )
        given = msgspec.structs.replace(group, assets=members, ignore_unknown=True)
        groups.setdefault(column, {})[value] = given
    return msgspec.structs.replace(mandate, groups=groups)


def _cell(row: dict[str, Any], column: str) -> str:
    return str(row.get(column) or "").strip()
