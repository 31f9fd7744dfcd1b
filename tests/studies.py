"""Made-up results of studies."""

import msgspec
import numpy as np

from qfolio.portfolio.study.evidence import TableReturns
from qfolio.portfolio.study.folder import Look, Result, StudyConfig, TableConfig, Variant
from qfolio.portfolio.study.summary import summarize

from tables import weekdays


def made_up(rng: np.random.Generator, days: int, edge: float, start: str) -> TableReturns:
    """Returns on a table, where the agents earn an edge a day over equal weights."""
    market = 0.0004 + 0.01 * rng.standard_normal(days)

    def near(drift: float) -> np.ndarray:
        return market + drift + 0.002 * rng.standard_normal(days)

    return TableReturns(
        tuple(map(str, weekdays(days, start).astype("datetime64[D]"))),
        252.0,
        {"tilts": near(edge), "pathwise": near(0.0)},
        {"equal-weight": market, "equal-weight at 0": near(-1e-5)},
        {"equal-weight": market, "minimum-variance": near(0.0)},
    )


def study(count: int, lags: int = 1, costs: int = 1, **names: str) -> tuple[StudyConfig, Result]:
    """A finished study of some tables; names: other names of tables."""
    rng = np.random.default_rng(0)
    tables = [names.get(f"t{i}", f"table-{i + 1}") for i in range(count)]
    each = [
        Variant(lag, cost) for lag in range(1, lags + 1) for cost in (0.001, 0.002, 0.005)[:costs]
    ]
    agents = ["tilts", "pathwise"]
    config = StudyConfig(
        tables={
            name: TableConfig(
                source="made up", digest=name, rows=2000, assets=5, first="2000-01-03",
                last="2008-01-02", note="Survivors.", trials=3,
            )
            for name in tables
        },
        left_out={"short": "120 rows are too few."},
        variants=each,
        agents=agents,
        train="1y",
        test="1y",
        command="qfolio study",
        device="1 × cpu",
        started="2026-01-02T03:04:05+00:00",
    )  # fmt: skip
    looks = [
        Look(study="", table=name, digest=name, lag=v.lag, cost=v.cost, agents=tuple(agents))
        for v in each
        for name in tables
    ]
    found = [
        {
            name: made_up(rng, 500 + 300 * (i % 7), 1e-4 + 4e-4 * (i == 1), f"{1960 + 2 * i}-01-04")
            for i, name in enumerate(tables)
        }
        for _ in each
    ]
    config = msgspec.structs.replace(config, looks=looks)
    return config, summarize(config, found)
