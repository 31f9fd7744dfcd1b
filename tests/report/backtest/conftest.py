from pathlib import Path

import pytest

from qfolio.report.backtest.data import BacktestData
from qfolio.report.backtest.page import render_backtest, write_backtest_report

from backtests import Page, hostile, usual


@pytest.fixture(scope="session")
def data() -> BacktestData:
    return usual()


@pytest.fixture(scope="session")
def page(data: BacktestData) -> Page:
    return Page(render_backtest(data))


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("new") / "report"
    write_backtest_report(folder, hostile())
    return folder
