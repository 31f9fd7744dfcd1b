"""What ``import qfolio`` offers."""

import qfolio


def test_dir_lists_what_there_is():
    assert {"train", "Backtest", "Pendulum", "DQN", "load_prices", "__version__"} <= set(
        dir(qfolio)
    )
    for name in dir(qfolio):
        assert getattr(qfolio, name) is not None
