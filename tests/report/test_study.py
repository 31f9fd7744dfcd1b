import pytest

from qfolio.commands.console.study import print_study
from qfolio.report.study import render_study

from backtests import ATTACK, Page
from browser import Browser
from studies import study


def page(count, lags=1, costs=1, **changes):
    config, result = study(count, lags, costs, **changes)
    return Page(render_study(config, result, {"train": "1y", "agents": {"tilts": {}}}, {}))


@pytest.mark.parametrize("count", [1, 6, 20])
def test_every_table_has_a_row_and_an_interval(count):
    shown = page(count)
    bars = [at for _, at in shown.tags if (at.get("class") or "").startswith("bar ")]
    pooled = count > 1
    assert len(bars) == 2 * (count + pooled)  # two agents, each with a pooled row
    assert all("95% interval" in (at["aria-label"] or "") for at in bars)
    styles = [at["style"] or "" for _, at in shown.tags if "left:" in (at.get("style") or "")]
    places = [float(style.split("left:")[1].split("%")[0].split(";")[0]) for style in styles]
    assert all(0 <= place <= 100 for place in places)
    assert "short is left out. 120 rows are too few." in shown.text
    for word in ("Pooled", "worst"):
        assert [each.strip() for each in shown.words].count(word) == 2 * pooled
    assert ("Its worst table is" in shown.text) == pooled


@pytest.mark.parametrize("costs", [1, 2])
def test_a_table_alone_is_not_pooled(costs, capsys):
    config, result = study(1, costs=costs)
    for pools in (each for entry in result.variants for each in entry.agents.values()):
        (only,) = pools.evidence.values()
        pooled = pools.to_reference
        shown = (pooled.growth, pooled.low, pooled.high, pooled.z)
        own = only.to_reference
        assert shown == pytest.approx((own.growth, own.low, own.high, own.z))
    print_study(result)
    page = Page(render_study(config, result, {}, {}))
    assert "tilts and pathwise on table-1" in page.text
    for text in (capsys.readouterr().out, page.text):
        for word in ("pool", "stouffer", "1 table", "tables", "table by table"):
            assert word not in text.lower().replace("in tables/", "")
        assert "in growth after costs on table-1: the difference in annual log growth is" in text
        assert "earlier looks at its table are known" in text


def test_the_page_shows_variants_and_counts_looks():
    assert "Other costs and lags" not in page(2).text
    shown = page(2, 2, 3)
    assert "Other costs and lags" in shown.text
    cells = [at.get("class") or "" for tag, at in shown.tags if tag == "td"]
    assert sum("main" in name.split() for name in cells) == 2
    assert "This study took 24 looks; 6 earlier looks at its tables are known." in shown.text
    assert "The best of 15 configurations without skill" in shown.text


def test_texts_of_others_cannot_run():
    config, result = study(2)
    config = type(config)(
        **{
            **{name: getattr(config, name) for name in config.__struct_fields__},
            "command": ATTACK,
            "left_out": {"short": ATTACK},
            "device": ATTACK,
        }
    )
    shown = Page(render_study(config, result, {ATTACK: ATTACK}, {}))
    assert not shown.scripts
    assert not [tag for tag, _ in shown.tags if tag in ("img", "script", "link")]
    assert ATTACK in shown.text


def test_wide_tables_say_so_on_a_phone(browser: Browser, tmp_path):
    """By the style that all pages share, without a script."""
    config, result = study(2, 2, 3)
    path = tmp_path / "report.html"
    path.write_text(render_study(config, result, {}, {}), encoding="utf-8")
    for label in ("tilts, table by table", "tilts, other costs and lags"):
        assert browser.cued(path.as_uri(), 375, label)
        assert not browser.cued(path.as_uri(), 1280, label)
