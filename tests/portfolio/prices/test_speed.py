"""Large tables are read once, and in a time that grows no faster than their cells."""

import time
from pathlib import Path
from unittest.mock import Mock

import pandas as pd
import pytest

from qfolio.portfolio.prices import delimited
from qfolio.portfolio.prices.table import load

from shell import qfolio
from tables import random_walk


def table(path: Path, rows: int, assets: int) -> Path:
    dates = pd.date_range("2000-01-03", periods=rows, freq="h")
    frame = pd.DataFrame(random_walk(rows, assets), dates)
    frame.columns = [f"A{j}" for j in range(assets)]
    frame.rename_axis("date").to_csv(path, float_format="%.4f")
    return path


def test_a_check_reads_the_table_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parse = Mock(wraps=delimited._parse)
    monkeypatch.setattr(delimited, "_parse", parse)
    assert qfolio(monkeypatch, "prices", table(tmp_path / "a.csv", 80, 3)) == 0
    parse.assert_called_once()


@pytest.mark.parametrize(("rows", "assets"), [(100, 200), (4000, 5)])
def test_time_grows_with_the_cells(tmp_path: Path, rows: int, assets: int) -> None:
    """Four times the columns or rows take far less than the sixteen times of a square."""

    def seconds(factor: int) -> float:
        wider = assets > rows
        size = (rows, assets * factor) if wider else (rows * factor, assets)
        path = table(tmp_path / "a.csv", *size)
        taken = []
        for _ in range(2):
            start = time.process_time()
            load(path)
            taken.append(time.process_time() - start)
        return min(taken)

    assert seconds(4) < 9 * seconds(1)
