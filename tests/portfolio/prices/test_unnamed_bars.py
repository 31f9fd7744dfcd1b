"""Bars of one asset are told from assets, whatever the columns are called."""

import numpy as np
import pandas as pd
import pytest

from tables import findings

DAYS = pd.bdate_range("2020-01-01", periods=250)


def bars(seed: int, drift: float = 0.0) -> pd.DataFrame:
    """Open, high, low and close of days of 20 steps each, with German names."""
    steps = np.random.default_rng(seed).normal(drift, 0.003, (len(DAYS), 20))
    path = steps.cumsum(axis=1) + np.append(0, steps.sum(axis=1)[:-1]).cumsum()[:, None]
    parts = path[:, 0], path.max(axis=1), path.min(axis=1), path[:, -1]
    names = "Eröffnung", "Hoch", "Tief", "Schluss"
    table = {name: 100 * np.exp(x) for name, x in zip(names, parts, strict=True)}
    return pd.DataFrame(table, index=DAYS)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("drift", [0.0, 0.0005])
def test_bars_are_told_by_their_prices(seed: int, drift: float):
    table = bars(seed, drift)
    for more in ({}, {"Volumen": 1e4 * table["Hoch"] ** 2}, {"Schluss bereinigt": table["Tief"]}):
        (error,) = findings(table.assign(**more), "error")
        assert error.message.startswith("'Eröffnung', 'Hoch', 'Tief', 'Schluss'")
        assert "'Hoch' is never below the others, and 'Tief' never above" in error.message
    late = table.shift(100).assign(Andere=np.arange(1.0, len(DAYS) + 1))
    assert "look like open, high" in findings(late, "error", late="join")[0].message


def test_assets_are_no_bars():
    """Neither those that cross each other, nor those that keep their order."""
    rng = np.random.default_rng(1)
    common = rng.normal(0, 0.01, (len(DAYS), 1)).cumsum(axis=0)
    own = rng.normal(0, 0.001, (len(DAYS), 6)).cumsum(axis=0)
    fees = np.outer(np.arange(len(DAYS)), np.linspace(2e-4, 0, 6))
    levels = np.linspace(0, 0.15, 6)
    for logs in (own, common + own, common - fees, common + own - fees, common + levels):
        table = pd.DataFrame(100 * np.exp(logs), DAYS, list("ABCDEF"))
        assert not findings(table, "error")
    assert not findings(bars(0)[["Hoch", "Tief", "Schluss"]], "error")
