from pathlib import Path

import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.portfolio.mandate import checks
from qfolio.portfolio.mandate.limits import (
    buyable,
    feasible,
    largest_weight,
    lots,
    mandate_text,
    parse,
    reach,
)
from qfolio.portfolio.mandate.mandate import Mandate

ASSETS = ["SPY", "TLT", "XLE", "XOM"]
ALL = np.ones(4, bool)

FILE = """
[assets]
cap = 0.5
floor = { SPY = 0.1 }
forbidden = ["TLT"]
[groups]
file = "groups.csv"
[groups.sector.Energy]
cap = 0.3
floor = 0.05
[cash]
min = 0.02
max = 0.4
[trading]
turnover = 0.3
smallest_trade = 0.01
holdings = 3
"""

GROUPS = "asset,sector\nSPY,Index\nTLT,Bonds\nXLE,Energy\nXOM,Energy\nother,Energy\n"


def written(folder: Path, text: str = FILE, groups: str = GROUPS) -> Path:
    (folder / "groups.csv").write_text(groups)
    (folder / "mandate.toml").write_text(text)
    return folder / "mandate.toml"


def notes_on(text: str, usable: np.ndarray) -> list[str]:
    """What is unusual about a mandate that can be met."""
    checks.require(text, usable)
    return checks.unusual(text, usable)


def test_lots_are_for_all_assets_or_for_some():
    assert lots("") is None
    assert lots(mandate_text({"assets": {"cap": 0.5}}, ASSETS)) is None
    for lot, each in ((100, [100] * 4), ({"TLT": 10}, [1, 10, 1, 1])):
        found = lots(mandate_text({"trading": {"lot": lot}}, ASSETS))
        assert found is not None
        assert found.tolist() == each
    with pytest.raises(QfolioError, match=r"trading\.lot of the mandate names 'TTL'.*TLT"):
        mandate_text({"trading": {"lot": {"TTL": 10}}}, ASSETS)
    with pytest.raises(QfolioError, match=r"trading\.lot"):
        mandate_text({"trading": {"lot": 0}}, ASSETS)


def test_keys_that_are_no_text_are_refused():
    with pytest.raises(QfolioError, match=r"a key in assets\.cap is 3; it must be text"):
        Mandate.of({"assets": {"cap": {3: 0.1}}})


def test_single_keys_take_precedence_over_a_file():
    given = Mandate.of({"assets": {"cap": 0.4}, "trading": {"turnover": 0.3, "holdings": 4}})
    made = given.changed(["trading.turnover=0.2", "trading.calendar = monthly",
                          "assets.floor.A=0.1", 'assets.cap={A = 0.5, "B.C" = 0.2}'])  # fmt: skip
    assert (made.trading.turnover, made.trading.holdings) == (0.2, 4)
    assert made.trading.calendar == "monthly"
    assert (made.assets.floor, made.assets.cap) == ({"A": 0.1}, {"A": 0.5, "B.C": 0.2})
    assert Mandate().changed([]) == Mandate()
    for wrong, message in {
        "trading.turn=1": r"--limits: \[trading\] has no key 'turn'",
        "trading.turnover": "--limits has 'trading.turnover'; it must be a key and a value",
        "trading turnover=1": "it must be a key and a value",
        "trading.turnover=much": "--limits: trading.turnover is 'much'; it must be a number",
        "assets.forbidden=A": r"""it must be a list, such as 'assets.forbidden=\["USO"\]'""",
        "assets.floor.A=0.1": "sets assets.floor.A, but the mandate has a floor of 0.05 for all",
    }.items():
        with pytest.raises(QfolioError, match=message):
            given.changed(["assets.floor=0.05"]).changed([wrong])
    assert given.changed(["trading.calendar=5"]).trading.calendar == "5"
    assert Mandate.of({"trading": {"calendar": 5}}).trading.calendar == "5"


def test_a_file_says_the_limits(tmp_path):
    made = feasible(mandate_text(written(tmp_path), ASSETS), ALL)
    limits = made.limits
    np.testing.assert_allclose(limits.high, [0.5, 0, 0.5, 0.5])
    np.testing.assert_allclose(limits.low, [0.1, 0, 0, 0])
    allowed = np.array([0.4, 0.4, 0, 0.1, 0.1])
    assert max(np.max(x) for x in made.violations(allowed).values()) <= 1e-9
    held = np.array([0.6, 0.2, 0, 0.105, 0.095])
    wrong = {k: float(x) for k, x in made.violations(allowed, held).items() if x > 1e-9}
    assert wrong == pytest.approx({"a trade is too small by": 0.005})
    outside = np.array([0.01, 0.05, 0.1, 0.42, 0.42])
    assert {k: round(float(x), 9) for k, x in made.violations(outside, held).items() if x > 0} == {
        "a weight is below its floor by": 0.05,
        "a weight is above its cap by": 0.1,
        "cash is below its minimum by": 0.01,
        "sector Energy is above its cap by": 0.54,
        "the number of holdings is too high by": 1.0,
        "turnover is too high by": 0.59,
    }


def test_its_text_is_whole_and_is_for_any_order_of_assets(tmp_path):
    mandate = Mandate.read(written(tmp_path))
    text = mandate_text(mandate, ASSETS)
    assert parse(text) == (ASSETS, mandate)
    assert mandate.groups["sector"]["Energy"].assets == ("XLE", "XOM", "other")
    turned = feasible(mandate_text(text, ASSETS[::-1]), ALL)
    np.testing.assert_allclose(turned.limits.low, [0, 0, 0, 0.1])
    assert mandate_text(None, ASSETS) == mandate_text("", ASSETS) == ""
    inline = {"assets": {"cap": 0.5}, "groups": {"kind": {"x": {"assets": ["XLE"], "cap": 0.1}}}}
    np.testing.assert_allclose(feasible(mandate_text(inline, ASSETS), ALL, 0.4).limits.high, 0.4)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[asset]\ncap = 0.1", "no key 'asset'; did you mean assets?"),
        ("[assets]\ncaps = 0.1", r"\[assets\] has no key 'caps'; did you mean cap?"),
        ("assets = 3", "assets is 3; it must be a table of keys and values"),
        ("[assets]\ncap = 'much'", "assets.cap is 'much'; it must be a number or a table"),
        ("[assets.cap]\nSPY = 0.1\nTLT = 4", "assets.cap.TLT is 4; it must be at most 3"),
        ("[groups.a]\nb = {cap = 1}\nc = {cap = 'x'}", "groups.a.c.cap is 'x'; .* a number"),
        ("[assets]\ncap = 20", "assets.cap is 20; it must be at most 3"),
        ("[trading]\nholdings = 2.5", "trading.holdings is 2.5; it must be a whole number"),
        ("[assets]\nforbidden = 'SPY'", 'it must be a list, such as \\["USO"\\]'),
        ("[cash", "is not valid TOML"),
        ("[assets]\nforbidden = ['SPX']", "'SPX', which is no asset of.* mean SPY"),
        ("[assets.cap]\nQQQ = 0.1", "assets.cap of the mandate names 'QQQ'.*choose from SPY"),
        ("[groups.sector.Energy]\ncap = 0.1", "sector Energy has none of the table's assets"),
        ("[groups]\nfile = 'none.csv'\n[groups.a.b]\ncap = 1", "cannot be read"),
        ("[groups]\nfile = 'groups.csv'\n[groups.sectors.Energy]\ncap = 1", "did you mean sector?"),
        ("[groups]\nfile = 'groups.csv'\n[groups.sector.energy]\ncap = 1", "did you mean Energy?"),
    ],
)  # fmt: skip
def test_what_is_wrong_in_a_file_is_said(tmp_path, text, message):
    with pytest.raises(QfolioError, match=message):
        mandate_text(written(tmp_path, text), ASSETS)


def test_a_file_that_is_no_text_is_refused(tmp_path):
    path = tmp_path / "mandate.toml"
    path.write_bytes(b"PK\x03\x04\xff\xfe")
    with pytest.raises(QfolioError, match=r"mandate\.toml is not UTF-8 text; write it as TOML"):
        mandate_text(path, ASSETS)


def test_the_example_of_the_guide_is_a_mandate(tmp_path):
    guide = (Path(__file__).parents[3] / "docs/guides/mandate.md").read_text(encoding="utf-8")
    toml, groups = (guide.split(fence)[1].split("\n```")[0] for fence in ("```toml", "```\nasset"))
    assets = ["SPY", "TLT", "USO", "GLD", "XLE", "XOM", "EWG"]
    path = written(tmp_path, toml, "asset" + groups)
    _, mandate = parse(mandate_text(path, assets))
    members = {name: group.assets for _, name, group in mandate.every_group}
    assert members == {"Energy": ("XLE", "XOM"), "US": ("XLE", "XOM"), "metals": ("GLD", "SLV")}


GROUP = {"assets": ["XLE", "XOM"]}


@pytest.mark.parametrize(
    ("mandate", "message"),
    [
        ({"assets": {"cap": 0.1}, "cash": {"max": 0.05}},
         r"the caps of assets \(10%\) and cash of at most 5% clash"),
        ({"groups": {"sector": {"E": {**GROUP, "cap": 0.1}}}, "assets": {"floor": 0.06}},
         r"the floors of assets \(6%\) and sector E of at most 10% clash"),
        ({"groups": {"a": {"E": {**GROUP, "cap": 0.1}}, "b": {"F": {**GROUP, "floor": 0.2}}}},
         "a E of at most 10% and b F of at least 20% clash"),
        ({"groups": {"a": {"E": {**GROUP, "cap": 0.1}}, "b": {"F is it": {**GROUP, "floor": 0.2}}}},
         "a E of at most 10% and b F is it of at least 20% clash"),
        ({"groups": {"a": {"E": {**GROUP, "cap": -0.5}}}, "assets": {"floor": -0.1}},
         r"the floors of assets \(-10%\) and a E of at most -50% clash"),
        ({"groups": {"a": {"E": {**GROUP, "cap": -0.5}}}}, "no weights have a E of at most -50%."),
        ({"assets": {"floor": 0.3}, "cash": {"min": 0.1}},
         r"the floors of assets \(30%\) and cash of at least 10% clash"),
        ({"assets": {"floor": {"SPY": 0.3}, "cap": 0.2}}, "floor of SPY, 30%, is above its cap"),
        ({"cash": {"min": 0.3, "max": 0.2}}, "minimum of cash, 30%, is above its maximum, 20%"),
        ({"assets": {"cap": 0.3}, "trading": {"holdings": 2}, "cash": {"max": 0.1}},
         "2 holdings at their caps leave 40% in cash"),
        ({"assets": {"cap": 0.3}, "trading": {"holdings": 1}, "cash": {"max": 0.1}},
         "1 holding at its cap leaves 70% in cash, and cash is at most 10%"),
        ({"assets": {"cap": {"SPY": 0.2, "TLT": 0.6, "XLE": 0.1, "XOM": 0.1}},
          "trading": {"holdings": 1}, "cash": {"max": 0.3}},
         "1 holding at its cap leaves 40% in cash, and cash is at most 30%"),
        ({"assets": {"cap": 2}, "cash": {"min": -3, "max": -2}, "exposure": {"gross": 2}},
         "cash of at most -200% and gross exposure of at most 200% clash"),
        ({"assets": {"floor": 0.1}, "trading": {"holdings": 3}}, "4 assets have a floor above 0"),
        ({"assets": {"floor": {"SPY": -0.3, "TLT": -0.3}, "cap": {"SPY": -0.1, "TLT": -0.1}},
          "trading": {"holdings": 1}, "cash": {"max": 2.0}}, "2 assets have a floor above 0 or a"),
        ({"assets": {"cap": 2.0}, "cash": {"min": -1.0}, "exposure": {"gross": 2.0, "margin": 0.6}},
         "exposure of 200% would break a margin of 60%, which allows 166.667%"),
        ({"cash": {"max": 0.1}, "exposure": {"gross": 0.5}},
         "cash of at most 10% and gross exposure of at most 50% clash"),
        ({"assets": {"floor": {"SPY": 0.2}, "forbidden": ["TLT", "SPY"]}},
         "the floor of SPY, 20%, and assets.forbidden, which names SPY, clash; change one of them"),
        ({"assets": {"forbidden": list(ASSETS)}}, "it allows no weight in any asset; change"),
        ({"assets": {"cap": {"SPY": -0.1}, "floor": -0.3, "forbidden": ["SPY"]}},
         "the cap of SPY, -10%, and assets.forbidden"),
        ({"groups": {"theme": {"oil": {"assets": ["XLE", "XMO"], "cap": 0.1}}}},
         "group theme oil names 'XMO', which is no asset of the table; did you mean XOM?"),
        ({"assets": {"cap": {"SPY": 2}}}, "The cap of SPY, 200%, is above 100%"),
    ],
)  # fmt: skip
def test_limits_that_clash_are_refused_with_their_names(mandate, message):
    with pytest.raises(QfolioError, match=message):
        checks.require(mandate_text(mandate, ASSETS), ALL)


@pytest.mark.parametrize(
    "mandate",
    [
        {"assets": {"cap": 2.0}, "cash": {"min": -1.0}, "exposure": {"gross": 2.0, "margin": 0.5}},
        {"assets": {"floor": 0.1}, "trading": {"holdings": 4}},
    ],
)
def test_limits_that_just_fit_are_met(mandate):
    checks.require(mandate_text(mandate, ASSETS), ALL)


def test_numbers_of_numpy_are_numbers():
    given = {"assets": {"cap": np.float64(0.4), "forbidden": np.array(["TLT"])},
             "trading": {"holdings": np.int64(3)}}  # fmt: skip
    plain = {"assets": {"cap": 0.4, "forbidden": ["TLT"]}, "trading": {"holdings": 3}}
    assert mandate_text(given, ASSETS) == mandate_text(plain, ASSETS)


def test_what_is_unusual_is_said():
    many = [f"A{i}" for i in range(15)]
    [note] = notes_on(mandate_text({"assets": {"cap": 0.05}}, many), np.ones(15, bool))
    assert note == "The mandate forces at least 25% cash: caps allow no more."
    bound = {"assets": {"cap": 0.1}, "groups": {"s": {"E": {**GROUP, "floor": 0.2}}}}
    notes = notes_on(mandate_text(bound, ASSETS), ALL)
    assert "no choice for s E: its floor, 20%" in notes[1]
    for limit in ("min", "max"):
        assert notes_on(mandate_text({"cash": {limit: 0.1}}, ASSETS), ALL) == []
    large = mandate_text({"trading": {"smallest_trade": 0.3}}, ASSETS)
    [note] = notes_on(large, ALL)
    assert note.startswith("The smallest trade, 30%, is more than an equal weight, 25%")
    assert notes_on(large, np.arange(4) < 2) == []  # of two, which is 50%
    file = {"assets": ["spy", "xl-e", "XOM", "gld"], "cap": 0.3, "ignore_unknown": True}
    notes = notes_on(mandate_text({"groups": {"sector": {"Energy": file}}}, ASSETS), ALL)
    assert [note.partition(":")[0] for note in notes] == [
        "SPY has no sector in the mandate's file of groups, which names spy",
        "XLE has no sector in the mandate's file of groups, which names xl-e",
    ]
    [note] = checks.unusual("", np.ones(15, bool), 0.05)
    assert note == "The cap of 5% for each of 15 assets forces at least 25% cash."
    [note] = checks.unusual("", np.arange(15) < 10, 0.05)
    assert note == "The cap of 5% for each of 10 assets forces at least 50% cash."
    assert checks.unusual("", ALL, 0.25) == checks.unusual("", ALL) == []


def test_a_floor_for_all_assets_is_for_those_that_may_be_held():
    text = mandate_text({"assets": {"floor": 0.1, "forbidden": ["TLT"]}}, ASSETS)
    assert notes_on(text, ALL) == []
    np.testing.assert_allclose(feasible(text, ALL).limits.low, [0.1, 0, 0.1, 0.1])


def test_every_way_to_give_a_mandate_may_name_a_file_of_groups(tmp_path, monkeypatch):
    mandate = Mandate.read(written(tmp_path), ["groups.sector.Index.floor=0.02", "cash.max=1.0"])
    assert mandate.cash.max == 1
    alone = Mandate.read(tmp_path / "mandate.toml").groups["sector"]["Energy"]
    assert mandate.groups["sector"]["Energy"] == alone
    index = mandate.groups["sector"]["Index"]
    assert (index.floor, index.assets) == (0.02, ("SPY",))
    monkeypatch.chdir(tmp_path)
    made = Mandate().changed(["groups.file=groups.csv", "groups.sector.Index.floor=0.02"])
    given = {"groups": {"file": "groups.csv", "sector": {"Index": {"floor": 0.02}}}}
    assert made == Mandate.of(given)
    assert made.groups["sector"]["Index"].assets == ("SPY",)
    assert given["groups"]["file"] == "groups.csv"
    with pytest.raises(QfolioError, match=r"--limits: .* has the sector 'Bond'; .* mean Bonds"):
        Mandate().changed(["groups.file=groups.csv", "groups.sector.Bond.floor=0.02"])
    with pytest.raises(QfolioError, match=r"none.csv cannot be read: No such file"):
        Mandate().changed(["groups.file=none.csv", "groups.sector.Index.floor=0.02"])


def test_a_line_of_a_file_of_groups_without_an_asset_is_passed_over(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "groups.csv").write_text("sector,asset\nIndex,SPY\nIndex\nIndex,\n")
    made = Mandate().changed(["groups.file=groups.csv", "groups.sector.Index.floor=0.02"])
    assert made.groups["sector"]["Index"].assets == ("SPY",)


def test_files_of_a_spreadsheet_are_read(tmp_path):
    """They begin with a byte order mark, and cells with a space."""
    plain = Mandate.read(written(tmp_path))
    marked = {"mandate.toml": FILE, "groups.csv": GROUPS.replace(",E", ", E")}
    for name, text in marked.items():
        (tmp_path / name).write_text(text, encoding="utf-8-sig")
    assert Mandate.read(tmp_path / "mandate.toml") == plain


def test_a_file_of_groups_may_name_assets_of_other_tables(tmp_path):
    mandate = Mandate.read(written(tmp_path)).changed(["cash.max=1.0"])
    assert "other" in mandate.groups["sector"]["Energy"].assets
    notes = notes_on(mandate_text(mandate, ASSETS), ALL)
    assert notes == ["The mandate forces at least 20% cash: caps allow no more."]


@pytest.mark.parametrize(
    ("mandate", "most", "high", "size"),
    [
        ({"assets": {"cap": 2}, "cash": {"min": -1}}, 1.0, 2, 2),
        ({"assets": {"cap": 2}, "cash": {"min": -1}}, 0.4, 0.4, 0.4),
        ({"assets": {"cap": 2, "floor": -3}}, 1.0, 2, 3),
        ({"assets": {"cap": 0.4, "floor": -0.1}}, 1.0, 0.4, 0.4),
        ({"cash": {"min": -1}}, 1.0, 1, 1),
        ({"assets": {"cap": 2}}, 1.0, 1, 1),  # which nothing can reach without a loan
    ],
)
def test_a_cap_above_1_holds_where_there_are_loans_or_shorts(mandate, most, high, size):
    text = mandate_text(mandate, ASSETS)
    np.testing.assert_allclose(feasible(text, ALL, most).limits.high, high)
    assert reach(text, most) == size
    assert largest_weight(text) <= 1  # of baselines, which have neither


def test_the_highest_cap_is_the_largest_weight():
    caps = dict(zip(ASSETS, (0.2, 0.6, 0.1, 0.1), strict=True))
    assert largest_weight(mandate_text({"assets": {"cap": caps}}, ASSETS)) == 0.6


@pytest.mark.parametrize(
    ("mandate", "gross"),
    [
        ({"assets": {"cap": 0.5}}, 1),  # a long-only one has its wealth alone
        ({"assets": {"cap": 0.4, "floor": -0.1}}, 1.6),
        ({"assets": {"cap": 0.1, "floor": -0.4}}, 1.6),
        ({"assets": {"cap": 0.4, "floor": -0.1}, "exposure": {"gross": 3}}, 1.6),
        ({"assets": {"cap": 2}, "cash": {"min": -1}, "exposure": {"gross": 1.5}}, 1.5),
    ],
)
def test_gross_exposure_is_bounded_by_all_caps_and_floors(mandate, gross):
    assert feasible(mandate_text(mandate, ASSETS), ALL).gross == pytest.approx(gross)


def test_what_is_forbidden_or_only_sold_short_cannot_be_bought():
    assets = {"forbidden": ["TLT"], "floor": -0.2, "cap": {"XLE": -0.1, "XOM": 0.0}}
    assert buyable(mandate_text({"assets": assets}, ASSETS)).tolist() == [True, False, False, False]


def test_short_sales_raise_no_more_cash_than_there_may_be():
    made = feasible(mandate_text({"assets": {"floor": -0.5}}, ASSETS), ALL)
    found = made.violations(np.array([1.2, 0.1, -0.3, 0, 0]))
    assert found["cash is above its maximum by"] == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("costs", "model"),
    [
        ({}, ""),
        ({"minimum": 1.0, "cash_rate": "0.03"}, "itemized(minimum=1.0, cash_rate=0.03)"),
        ({"model": "proportional", "cost": 0.002}, "proportional(cost=0.002)"),
    ],
)
def test_costs_name_their_model_and_its_settings(costs, model):
    assert Mandate.of({"costs": costs}).cost_model == model


def test_floors_yield_where_assets_cannot_be_traded():
    mandate = {"assets": {"cap": 0.3, "floor": {"XOM": 0.1}}, "cash": {"max": 0.2},
               "groups": {"sector": {"E": {**GROUP, "floor": 0.25}}}}  # fmt: skip
    text = mandate_text(mandate, ASSETS)
    assert checks.relaxed(feasible(text, ALL))[1] == []
    made, lowered = checks.relaxed(feasible(text, np.array([True, True, False, False])))
    assert sorted(x.partition(" by ")[0] for x in lowered) == ["cash", "sector E"]
    assert max(np.max(x) for x in made.violations(np.array([0.4, 0.3, 0.3, 0, 0])).values()) <= 1e-9


def test_floors_yield_to_the_number_of_holdings():
    """Of a floor of 50%, one asset at its cap of 30% leaves 20% out of reach."""
    mandate = {"assets": {"cap": 0.3}, "groups": {"sector": {"E": {**GROUP, "floor": 0.5}}},
               "trading": {"holdings": 1}}  # fmt: skip
    assert checks.relaxed(feasible(mandate_text(mandate, ASSETS), ALL))[1] == ["sector E by 20%"]
