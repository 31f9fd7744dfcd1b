import json

import pytest

from qfolio.core.errors import QfolioError
from qfolio.portfolio.desk.standing import Standing

RESUME = "qfolio backtest --resume run --trust mine"


def summary(folder, growth, drawdown, finding):
    difference = {"growth": {"finding": finding}}
    strategy = {
        "measures": {"growth": {"per_seed": growth}, "drawdown": {"per_seed": drawdown}},
        "to_reference": difference,
        "to_rebalanced": None,
    }
    found = {"strategies": {"tilts": strategy}, "verdicts": {"tilts": ["tilts did something."]}}
    (folder / "summary.json").write_text(json.dumps(found))


@pytest.mark.parametrize(
    ("growth", "drawdown", "finding", "worse"),
    [
        ([0.05, 0.06], [0.2, 0.3], "none", False),
        ([0.05, 0.06], [0.2, 0.3], "worse", True),
        ([0.05, -1.0], [0.2, 1.0], "none", True),  # no statistics are left of a lost account
        ([0.05, -1.0], [0.2, 0.5], "none", False),  # half of it in three days, on minutes
    ],
)
def test_a_policy_that_is_worse_or_loses_everything_is_not_followed_unasked(
    tmp_path, growth, drawdown, finding, worse
):
    summary(tmp_path, growth, drawdown, finding)
    standing = Standing.of(tmp_path, "tilts")
    assert standing.worse is worse
    standing.require_sound(RESUME, named=True)
    if worse:
        with pytest.raises(QfolioError, match="tilts did something; to trade it nevertheless"):
            standing.require_sound(RESUME, named=False)
    else:
        standing.require_sound(RESUME, named=False)


def test_a_backtest_that_is_not_finished_is_not_followed_unasked(tmp_path):
    standing = Standing.of(tmp_path, "tilts")
    with pytest.raises(QfolioError, match=f"finish it with {RESUME}, or allocate with --anyway"):
        standing.require_sound(RESUME, named=True)
