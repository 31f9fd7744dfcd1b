"""The page of live results."""

import numpy as np
import pytest

from qfolio.report.follow import LiveRows, draw_following


@pytest.mark.parametrize("days", [2, 60, 400, 1500])
@pytest.mark.parametrize("width", [4.0, 8.6])
def test_dates_fit_any_time(days: int, width: float) -> None:
    """Nothing warns, which a person who follows a run would read on the console."""
    dates = np.busday_offset("2022-06-02", np.arange(days), roll="forward")
    flat = np.ones(days)
    band = np.stack([0.9 * flat, flat, 1.1 * flat])
    rows = LiveRows(dates.astype("datetime64[s]"), flat, flat, "other", band, flat, 40.0)
    figure = draw_following(rows, width)
    figure.draw_without_rendering()
    assert len(figure.axes[-1].get_xticks()) >= 2
