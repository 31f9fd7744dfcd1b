import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.experiments.presets import Preset, preset
from qfolio.portfolio.few_rows import fitted
from qfolio.portfolio.task import Portfolio

from tables import price_table, random_walk
from tiny import with_task


def months(rows):
    dates = np.arange(rows).astype("datetime64[M]")
    return price_table(random_walk(rows, volatility=0.04), dates=dates)


@pytest.mark.parametrize("name", ["tilts", "dqn", "reinforce", "ppo"])
@pytest.mark.parametrize("lag", [1, 3])
def test_a_horizon_that_does_not_fit_is_halved(name, lag):
    given = with_task(preset("fast", "portfolio", name), window=2)
    horizon = given.task["horizon"]
    enough = 2 + horizon + lag + 1
    Portfolio.of(months(enough), **given.task, lag=lag)
    assert fitted(given, enough, lag) == given
    with pytest.raises(QfolioError, match="rows are too few"):
        Portfolio.of(months(enough - 1), **given.task, lag=lag)
    short = fitted(given, enough - 1, lag)
    assert short.task == {**given.task, "horizon": horizon // 2}
    Portfolio.of(months(enough - 1), **short.task, lag=lag)
    assert fitted(with_task(given, lag=lag), enough - 1).settings == short.settings
    assert fitted(given, 12, lag) == given  # nothing fits, so the error names the preset's


def test_a_path_is_at_most_an_episode():
    given = {name: preset("fast", "portfolio", name) for name in ("tilts", "pathwise", "ppo")}
    short = {name: fitted(with_task(each, window=1), 59) for name, each in given.items()}
    assert short["tilts"].settings["rollout_length"] == 42
    for name in ("pathwise", "ppo"):  # these paths fit, or may span several episodes
        assert short[name].settings == given[name].settings
    assert fitted(with_task(given["tilts"], horizon=40), 59).settings["rollout_length"] == 40
    assert fitted(given["tilts"], 32).task["horizon"] == 28
    learned = preset("fast", "portfolio", "minimum-variance-learned")
    assert fitted(learned, 560) == learned  # 21 of its steps do not count


def test_what_the_user_has_chosen_is_kept():
    given = preset("fast", "portfolio", "tilts")
    assert fitted(with_task(given, horizon=80), 59).task["horizon"] == 80
    chosen = given._replace(settings={"rollout_length": 28})
    assert fitted(chosen, 59) == chosen
    assert fitted(Preset("dqn", {}, task={"horizon": 63}), 59).task["horizon"] == 63
