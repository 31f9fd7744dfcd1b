"""Assets with the same returns are named, and assets that move nearly alike are not."""

import time

import numpy as np
import pandas as pd

from qfolio.portfolio.prices.findings import Finding

from tables import findings

ROWS, ASSETS = 500, 12
DAYS = pd.bdate_range("2020-01-01", periods=ROWS)
NAMES = [f"A{j}" for j in range(ASSETS)]


def market(assets: int = ASSETS, rows: int = ROWS) -> np.ndarray:
    """Prices of about 50 that a market moves, as printed."""
    rng = np.random.default_rng(3)
    moves = rng.normal(0, 0.01, (rows, 1)) + rng.normal(0, 0.01, (rows, assets))
    return np.asarray(np.round(50 * np.exp((moves / 2).cumsum(0)), 2))


def found(values: np.ndarray) -> list[Finding]:
    frame = pd.DataFrame(values, DAYS, NAMES)
    return [f for f in findings(frame, late="join", ended="cash-out") if "same" in f.message
            or "returns" in f.message]  # fmt: skip


def test_one_asset_under_two_names():
    values = market()
    assert found(values) == []
    values[:, 7] = values[:, 2]
    values[100, 7] *= 1.01  # one price corrected in one of them
    (warning,) = found(values)
    assert warning.severity == "warning"
    assert (
        warning.message == "'A2' and 'A7' have the same prices: perhaps one asset under two names"
    )
    assert warning.advice.startswith("If so, keep one")


def test_one_asset_in_two_units():
    values = market()
    values[:, 7] = 100 * values[:, 2]
    (warning,) = found(values)
    assert warning.message.startswith("'A7' has the returns of 'A2', at 100 times its price")
    values[:, 7] = np.round(2.5 * values[:, 2] * 1.37, 2)  # printed anew
    assert "at 3.425 times its price" in found(values)[0].message
    values[:, 7] = (values[:, 2] / 3).astype(np.float32)
    assert "at 0.333333 times its price" in found(values)[0].message


def test_assets_that_come_and_go_and_several_names():
    values = market()
    values[:, 7] = values[:, 9] = values[:, 2]
    values[250:, 2] = np.nan
    values[:300, 7] = np.nan  # both are compared with the third
    values[:, 5] = values[:, 4]
    several, two = found(values)
    assert several.message.startswith("'A2', 'A7', 'A9' have the same returns: perhaps one asset")
    assert two.message.startswith("'A4' and 'A5' have the same prices")


def test_what_moves_nearly_alike_is_another_asset():
    """Share classes, funds on one index, and bonds whose moves are of a cent."""
    rng, values = np.random.default_rng(0), market()
    values[:, 7] = np.round(values[:, 2] * np.exp(rng.normal(0, 1e-3, ROWS)), 2)
    assert found(values) == []
    values[:, 2] *= 8
    values[:, 7] = np.round(values[:, 2] * np.exp(rng.normal(0, 1e-4, ROWS)), 2)
    assert found(values) == []
    cents = rng.integers(-1, 2, (ROWS, ASSETS)).cumsum(0)
    assert found(np.round(100 + cents / 100, 2)) == []
    rates = rng.uniform(0.03, 0.035, ASSETS) / 252
    assert found(np.round(np.exp(rates * np.arange(ROWS)[:, None]), 4)) == []
    assert found(np.exp(rates * np.arange(ROWS)[:, None])) == []


def test_a_large_table_takes_no_time():
    values = market(1000, 2000)
    values[:, 999] = values[:, 0]
    frame = pd.DataFrame(values, pd.bdate_range("2000-01-01", periods=2000)).rename(columns=str)
    start = time.process_time()
    assert [f.message.partition(":")[0] for f in findings(frame)] == [
        "'0' and '999' have the same prices"
    ]
    assert time.process_time() - start < 10  # about one second
