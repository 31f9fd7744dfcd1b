"""What ``import qfolio`` offers."""

import json
import subprocess
import sys

import pytest

import qfolio

from tables import write_table


def test_dir_lists_what_there_is():
    assert {"train", "Backtest", "Pendulum", "DQN", "load_prices", "__version__"} <= set(
        dir(qfolio)
    )
    for name in dir(qfolio):
        assert getattr(qfolio, name) is not None


WRONG_TYPES = {
    "Backtest.create(prices, 'tilts')": "agents is 'tilts'; it must be a dictionary of presets",
    "Backtest.create(prices, [tilts])": "agents is [Preset(agent=",
    "Backtest.create(prices, {'tilts': 'fast'})": "agents['tilts'] is 'fast'; it must be a preset",
    "Backtest.create(prices, {'tilts': [tilts]})": "agents['tilts'] is [Preset(",
    "Backtest.create(prices, agents, train=4)": "A length is 4; it must be like 5y",
    "Backtest.create(prices, agents, seeds='3')": "seeds is '3'; it must be a whole number.",
    "Backtest.create(prices, agents, lag=1.5)": "lag is 1.5; it must be a whole number.",
    "Backtest.create(prices, agents, cap='1')": "cap is '1'; it must be a number.",
    "Backtest.create(prices, agents, mandate=3)": "mandate is 3; it must be a path, or",
    "Backtest.create(prices, agents, baselines=3)": "baselines is 3; it must be a list of names.",
    "Backtest.create(prices, agents, baselines=[3])": "baselines is [3]; it must be a list of",
    "Backtest.create(prices, agents, cost_model=3)": "cost_model is 3; it must be text, such as",
    "Backtest.create(prices, agents, train='90d', cost=None)": "cost is null; it must be a number.",
    "Backtest.create(prices, agents, strategies='my.csv')": "strategies is 'my.csv'; it must be a",
    "Backtest.create(prices, agents, expanding='no')": "expanding is 'no'; it must be True or",
    "Backtest.create(prices, agents, seeds=True)": "seeds is True; it must be a whole number.",
    "Backtest.create(prices, agents, cap=True)": "cap is True; it must be a number.",
    "Backtest.create(prices, agents, title=3)": "title is 3; it must be text.",
    "Backtest.create(prices, agents, command=3)": "command is 3; it must be text.",
    "Backtest.create(prices, {'dqn': DQN()}, task=3)": "task is 3; it must be a dictionary of",
    "Backtest.create(prices, agents, out=3)": "out is 3; it must be a path, such as",
    "Backtest.open(3)": "folder is 3; it must be a path, such as",
    "Study.create(prices, agents, out='nowhere')": "tables is <Prices: ",
    "Study.create({'a': prices}, agents, train=4, out='nowhere')": "A length is 4; it must be",
    "Study.create({'a': prices}, agents, lags=1, out='nowhere')": "lags is 1; it must be a list",
    "Study.create({'a': prices}, agents, costs=.1, out='nowhere')": "costs is 0.1; it must be a",
    "Study.create({'a': prices}, agents, after='runs/x', out='nowhere')": "after is 'runs/x'; it",
    "Study.create({'a': prices}, agents, trials='x', out='nowhere')": "trials is 'x'; it must be a",
    "Study.create({'a': prices}, agents, lags=[True], out='nowhere')": "lags is [True]; it must",
    "Study.create({'a': prices}, agents, out=3)": "out is 3; it must be a path, such as",
    "Study.create({'a': prices}, agents, command=3, out='nowhere')": "command is 3; it must be",
    "Study.open(3)": "folder is 3; it must be a path, such as",
    "Portfolio.of('prices.csv')": "prices is 'prices.csv'; it must be a table that",
    "finish('runs/mine')": "backtest is 'runs/mine'; it must be a backtest, such as",
    "policy.weights(prices, 'my.csv')": "holdings is 'my.csv'; it must be a dictionary",
    "policy.weights(prices, spent=None)": "spent is None; it must be a number of at least 0.",
    "load_prices('prices.csv', delisting_haircut='a')": "delisting_haircut is 'a'; it must be a n",
    "train('pendulum', DQN(), episodes=1)": "task is 'pendulum'; it must be a task, such as",
    "train(Pendulum(), 'dqn', episodes=1)": "agent is 'dqn'; it must be an agent, such as",
    "train(Pendulum(), DQN, episodes=1)": "agent is <class 'qfoli",
    "train(Pendulum(), DQN(), episodes='3')": "episodes is '3'; it must be a whole number.",
    "train(Pendulum(), DQN(), episodes=1, executor=3)": "executor is 3; it must be text such as",
    "train(Pendulum(), DQN(), episodes=1, executor='two')": "'two' names no executor; it must be",
    "train(Pendulum(), DQN(), episodes=1, seeds=True)": "seeds is True; it must be a whole",
    "train(Pendulum(), DQN(), episodes=1, out=3)": "out is 3; it must be a path, such as",
    "Run.create(Pendulum(), DQN(), budget=3)": "budget is 3; it must be a budget, such as",
    "Run.create(Pendulum(), DQN(), episodes=1, preset=3)": "preset is 3; it must be text.",
    "Run.create(Pendulum(), DQN(), episodes=1).train(3)": "budget is 3; it must be a budget,",
    "Run.open(3)": "folder is 3; it must be a path, such as",
    "Policy.open(3)": "folder is 3; it must be a path, such as",
    "DQN(batch_size=64.5)": "batch_size is 64.5; it must be a whole number.",
    "DQN(batch_size=[64])": "batch_size is [64]; it must be a whole number.",
    "DQN(hidden=3)": "hidden is 3; it must be whole numbers separated by commas, for",
    "DQN(hidden=(64, 0.5))": "hidden is [64, 0.5]; it must be whole numbers separated by",
    "DQN(double='no')": 'double is "no"; it must be true or false.',
    "DQN(learning_rate='x')": 'learning_rate is "x"; it must be a number.',
    "Pendulum(horizon=0)": "horizon is 0; it must be",
    "Pendulum(mass=None)": "mass is null; it must be a number.",
    "Portfolio.of(prices, anchor=3)": "anchor is 3; it must be text.",
    "preset('fast', Pendulum())": "task is Pendulum(); it must be text.",
    "read_holdings(None, ['A'], '100')": "capital is '100'; it must be a sum of money, such as",
    "read_holdings(None, ['A'], True)": "capital is True; it must be a sum of money, such as",
    "require_fresh(prices, 7)": "--as-of is '7'; it must be a date such as 2025-12-31 or,",
}


@pytest.fixture(scope="module")
def said(tmp_path_factory):
    """What each of these calls answers, in a process where types are not checked."""
    folder = tmp_path_factory.mktemp("types")
    write_table(folder / "prices.csv")
    script = f"""if True:
        import json, qfolio
        from qfolio.portfolio.desk.allocation import require_fresh
        from qfolio.portfolio.desk.holdings import read_holdings
        names = {{name: getattr(qfolio, name) for name in dir(qfolio)}}
        names |= {{"read_holdings": read_holdings, "require_fresh": require_fresh}}
        names["prices"] = qfolio.load_prices("prices.csv")
        names["tilts"] = qfolio.preset("fast", "portfolio", "tilts")
        names["agents"] = {{"tilts": names["tilts"]}}
        task = qfolio.Portfolio.of(names["prices"])
        names["policy"] = qfolio.Policy(task, qfolio.Tilts(), None, names["prices"].assets)
        said = {{}}
        for call in {list(WRONG_TYPES)}:
            try:
                eval(call, names)
            except Exception as error:
                said[call] = f"{{type(error).__name__}}: {{error}}"
        print(json.dumps(said))"""
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, cwd=folder, check=True, stdout=subprocess.PIPE)
    return json.loads(done.stdout)


@pytest.mark.parametrize("call", WRONG_TYPES)
def test_a_wrong_type_is_said_in_a_sentence(said, call):
    assert said.get(call, "").startswith(f"QfolioError: {WRONG_TYPES[call]}")
