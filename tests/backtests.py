"""Made-up backtests to report, one of them hostile, and a page read as text."""

import json
from dataclasses import replace
from html.parser import HTMLParser
from typing import Any

import numpy as np

from qfolio.portfolio.backtest.attribution.decomposition import AssetPart, Decomposition, FoldPart
from qfolio.portfolio.backtest.attribution.distillation import Rule, Term
from qfolio.portfolio.backtest.attribution.factors import Exposure, Exposures
from qfolio.portfolio.backtest.attribution.gradients import Gradients, Pull
from qfolio.portfolio.backtest.attribution.importance import Importance, Worth
from qfolio.portfolio.backtest.attribution.slices import Slice, Slices
from qfolio.portfolio.backtest.attribution.why import AgentWhy, Why
from qfolio.portfolio.backtest.statistics.assessment import Strategy, assess
from qfolio.report.backtest.data import BacktestData, StrategySeries

from tables import weekdays

ATTACK = "</script><script>hacked = 1</script><img src=x onerror='hacked = 1'>"
LINK = "<a href=\"javascript:hacked = 1\">%{x}</a> & 'quotes' $x^2$"


def make_series(
    rng: np.random.Generator, kind: str, seeds: int, days: int, assets: int, drift: float
) -> StrategySeries:
    weights = rng.dirichlet(np.ones(assets + 1), size=days)
    turnover = rng.uniform(0, 0.1, (seeds, days))
    returns = drift + 0.01 * rng.normal(size=(seeds, days))
    return StrategySeries(kind, returns, turnover, 0.001 * turnover, weights)


def make_data(
    strategies: dict[str, StrategySeries], dates: np.ndarray, assets: tuple[str, ...], **more: Any
) -> BacktestData:
    first, last = (str(dates[i].astype("datetime64[D]")) for i in (0, -1))
    data = BacktestData(
        title="A backtest",
        command="qfolio backtest --seeds 3",
        assessment=assess(
            {
                name: Strategy(series.kind, series.returns, series.turnover, series.cost)
                if series.weighted
                else Strategy(series.kind, series.returns, None, None)
                for name, series in strategies.items()
            },
            dates,
            periods_per_year=252,
            reference="equal weight",
            resamples=400,
            earlier_trials=5,
        ),
        dates=dates,
        assets=assets,
        strategies=strategies,
        prices={
            "source": "made up",
            "rows": 1234,
            "assets": len(assets),
            "first": "1999-01-04",
            "last": last,
            "note": "These assets are survivors.",
            "digest": "sha256:0123456789",
        },
        config={
            "cost": 0.0025,
            "lag": 1,
            "train": "2y",
            "test": "6m",
            "expanding": False,
            "cap": 0.3,
            "cost_model": "proportional",
            "calendar": "",
            "mandate": None,
            "agents": {"DQN": {"settings": {"discount": 0.98}}},
        },
        folds=[
            {
                "name": first,
                "train_first": "1999-01-04",
                "train_last": str(dates[0] - np.timedelta64(2, "D")),
                "test_first": first,
                "test_last": last,
            }
        ],
        notes=[],
        moves=np.zeros((len(dates), len(assets))),
        risk_free=np.zeros(len(dates)),
        begin=dates[0] - min(np.timedelta64(1, "D"), dates[1] - dates[0]),
    )
    return replace(data, **more)


def usual(days: int = 300, seeds: int = 3, **more: Any) -> BacktestData:
    rng = np.random.default_rng(3)
    series = {
        "equal weight": make_series(rng, "baseline", 1, days, 4, 0.0003),
        "best of all": make_series(rng, "baseline", 1, days, 4, 0.003),
        "third": make_series(rng, "baseline", 1, days, 4, -0.001),
        "slow": make_series(rng, "rebalancing", 1, days, 4, 0.0004),
        "never": make_series(rng, "rebalancing", 1, days, 4, 0.0002),
        "DQN": make_series(rng, "agent", seeds, days, 4, 0.0005),
        "DQN-together": make_series(rng, "ensemble", 1, days, 4, 0.0005),
        "pathwise": make_series(rng, "agent", seeds, days, 4, 0.02),
    }
    return make_data(series, weekdays(days, "2001-01-02"), ("A", "B", "C", "D"), **more)


def of_returns_alone() -> BacktestData:
    """A reference and a strategy of the user's own of which only returns are known."""
    data = usual()
    strategies = dict(data.strategies)
    for name, kind in (("equal weight", "baseline"), ("third", "strategy")):
        series = strategies[name]
        unknown = np.full_like(series.turnover, np.nan)
        weights = np.full_like(series.weights, np.nan)
        strategies[name] = StrategySeries(kind, series.returns, unknown, unknown, weights)
    del strategies["slow"], strategies["never"]
    return make_data(strategies, data.dates, data.assets)


def hostile() -> BacktestData:
    """Every text that a user can choose tries to inject markup."""
    data = usual(60)
    names = {"DQN": f"DQN {ATTACK}", "third": LINK}
    strategies = {names.get(name, name): series for name, series in data.strategies.items()}
    return make_data(
        strategies,
        data.dates,
        (ATTACK, LINK, "C", "\u2028</SCRIPT>"),
        title=f"Title {ATTACK}",
        command=f"qfolio {ATTACK}",
        notes=[f"Note {ATTACK}", LINK],
        prices={**data.prices, "source": ATTACK, "note": ATTACK, "digest": ATTACK},
        config={**data.config, "train": ATTACK, ATTACK: {ATTACK: [ATTACK]}},
        folds=[{**data.folds[0], "name": ATTACK}],
        why=made_up_why(
            names["DQN"], (ATTACK, LINK), (ATTACK, LINK, "C", "\u2028</SCRIPT>"), ATTACK
        ),
    )


def made_up_why(
    name: str = "DQN-together",
    signals: tuple[str, ...] = ("momentum:20", "volatility:21"),
    assets: tuple[str, ...] = ("A", "B", "C", "D"),
    fold: str = "2001-01-02",
) -> Why:
    """Attributions of one agent, with any names."""
    x, up, down = [-1.0, 0.0, 1.0], [0.1, 0.15, 0.2], [0.2, 0.2, 0.2]
    worth = [Worth(signals[0], 0.012, 0.01, 0.02, 2.3, False),
             Worth(signals[1], -0.001, -0.002, 0.001, -0.4, True)]  # fmt: skip
    agent = AgentWhy(
        decomposition=Decomposition(
            0.142, 0.131, 0.004, 0.011, 1.7, 0.004,
            [AssetPart(each, 0.2, 0.03, 0.002) for each in ("cash", *assets)],
            [FoldPart(fold, 0.135, 0.02, 0.004, 0.151), FoldPart("next", 0.1, -0.01, 0.004, 0.086)],
        ),
        exposures=Exposures(0.021, 2.4, 0.31, 7, [Exposure("market", -0.02, -1.2)]),
        importance=Importance(worth, Worth("all together", 0.01, 0.0, 0.02, 1.2, False),
                              False, 3, 5, 10),
        slices=Slices(
            assets[0], assets[1], Slice("weight held", [0.0, 0.1, 0.2], [up, down], [], False),
            [Slice(each, x, [up, down], [down, down], False) for each in signals],
        ),
        gradients=Gradients(
            [Pull(signals[0], 0.02, 0.9), Pull(signals[1], 0.0, 0.0)], 24, 0.02, 0.0
        ),
        rule=Rule([Term(signals[0], 0.05, 0.03)], 0.64, [signals[1]]),
        menu=False,
    )  # fmt: skip
    return Why("equal weight", {name: agent}, {name: [f"{name} traded once and never again."]})


class Page(HTMLParser):
    """The start tags of a page, its visible text, and the contents of its scripts."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[str] = []
        self.words: list[str] = []
        self._open = ""
        self.feed(page)
        self.text = " ".join("".join(self.words).split())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self._open = tag
        if tag == "script":
            self.scripts.append("")

    def handle_endtag(self, tag: str) -> None:
        self._open = ""

    def handle_data(self, data: str) -> None:
        if self._open == "script":
            self.scripts[-1] += data
        elif self._open != "style":
            self.words.append(data)

    @property
    def data(self) -> Any:
        return json.loads(self.scripts[0])
