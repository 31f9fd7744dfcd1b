"""What is said of an allocation's orders."""

import numpy as np
import pytest

from qfolio.portfolio.desk.desk import waiting
from qfolio.portfolio.prices.table import Prices

MONTHS = np.arange("2024-01", "2025-01", dtype="datetime64[M]").astype("datetime64[D]")
WEEKS = np.datetime64("2024-01-05") + 7 * np.arange(10)
DAYS = np.datetime64("2024-01-05") + np.arange(10)


@pytest.mark.parametrize(
    ("dates", "lag", "said"),
    [
        (MONTHS, 1, "1 row later, after about 31 days; if you trade at once"),
        (WEEKS, 2, "2 rows later, after about 14 days; if you trade at once"),
        (MONTHS, 0, ""), (DAYS, 1, ""), (DAYS[:1], 1, ""),
    ],
)  # fmt: skip
def test_orders_that_wait_for_weeks_are_named(dates, lag, said):
    found = " ".join(waiting(Prices(dates, ("A",), np.ones((len(dates), 1))), lag))
    assert said in found
    assert bool(found) == bool(said)
