"""What a backtest needs is said before anything is made."""

import pytest

from qfolio.core import devices
from qfolio.core.errors import QfolioError
from qfolio.experiments import presets
from qfolio.portfolio.backtest.memory import needed, total
from qfolio.portfolio.backtest.run import Backtest
from qfolio.portfolio.prices.table import Prices

from tables import price_table, random_walk

GIB = 2**30


def table() -> Prices:
    return price_table(random_walk(600, 40), [f"A{j}" for j in range(40)])


def create(prices: Prices, **options) -> Backtest:
    agents = {name: presets.preset("fast", "portfolio", name) for name in ("tilts", "dqn")}
    return Backtest.create(prices, agents, train="300d", test="100d", **options)


def test_too_large_a_backtest_is_refused_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(devices, "host_memory", lambda: 2**20)
    with pytest.raises(QfolioError, match=r"40 assets on 600 rows with 3 seeds needs about 0\.\d"):
        create(table(), seeds=3, out=tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_the_estimate_covers_the_arrays_of_the_replay():
    backtest = create(table(), seeds=2, baselines=["trend"])
    days = len(backtest.dates)
    paths = 2 * (2 + 1) + 2 + 5  # agents with their ensembles, baselines, speeds
    assert needed(backtest.prices, backtest.config) > paths * 2 * 8 * days * 41
    assert needed(backtest.prices, backtest.config) < GIB / 10


def test_each_seed_adds_its_decisions_and_weights():
    days, assets = 900, 4000
    few, many = (total(1000, days, assets, [13, 13], seeds, 23) for seeds in (5, 25))
    assert many - few == 2 * 20 * 2 * 8 * days * (assets + 1)


def test_the_statistics_of_many_rows_are_counted():
    """Measured: 0.81 GiB for them alone."""
    assert 0.81 * GIB < total(200_000, 100_000, 1, [20], 5, 23) < 1.2 * GIB


def test_it_grows_with_the_assets_and_no_faster():
    """20 years of days, 12 channels, 5 seeds of two agents, 23 other strategies."""

    def size(assets: int) -> int:
        return total(5040, 3780, assets, [13, 13], 5, 23)

    assert size(1000) == pytest.approx(2 * size(500), rel=0.01)
    assert GIB < size(500) < 4 * GIB
