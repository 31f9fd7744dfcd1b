import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.experiments.presets import Preset, preset
from qfolio.portfolio.prices.table import Prices
from qfolio.portfolio.short import fitted
from qfolio.portfolio.task import Portfolio


def months(rows):
    values = 50 * np.exp(np.cumsum(np.random.default_rng(0).normal(0, 0.04, (rows, 3)), axis=0))
    return Prices(np.datetime64("2000-01") + np.arange(rows), ("A", "B", "C"), values, note="")


@pytest.mark.parametrize("name", ["tilts", "dqn", "reinforce", "pathwise"])
@pytest.mark.parametrize("lag", [1, 3])
def test_a_horizon_is_halved_where_it_does_not_fit(name, lag):
    given = preset("fast", "portfolio", name)
    horizon, fewest = given.task["horizon"], given.task["window"] + given.task["horizon"] + lag + 1
    Portfolio.of(months(fewest), **given.task, lag=lag)
    assert fitted(given, fewest, lag) is given
    with pytest.raises(QfolioError, match="rows are too few"):
        Portfolio.of(months(fewest - 1), **given.task, lag=lag)
    short = fitted(given, fewest - 1, lag)
    assert short.task == {**given.task, "horizon": horizon // 2}
    Portfolio.of(months(fewest - 1), **short.task, lag=lag)
    with_lag = given._replace(task={**given.task, "lag": lag})
    assert fitted(with_lag, fewest - 1).settings == short.settings


def test_a_path_is_at_most_an_episode():
    paths = {
        name: preset("fast", "portfolio", name) for name in ("tilts", "pathwise", "dqn", "ppo")
    }
    short = {name: fitted(given, 60, 1) for name, given in paths.items()}
    assert short["tilts"].settings["rollout_length"] == 42
    for name in ("pathwise", "dqn", "ppo"):  # these paths fit, or may span several episodes
        assert short[name].settings == paths[name].settings
    odd = preset("fast", "portfolio", "minimum-variance-learned")
    assert fitted(odd, 60, 1) is odd
    assert fitted(Preset("dqn", {}), 60).task == {"horizon": 25}  # of the task's defaults
