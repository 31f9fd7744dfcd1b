from qfolio.commands.console import console
from qfolio.commands.console.training import print_rule
from qfolio.report.rule import Row, rows


def test_a_seed_without_an_edge_is_named_as_the_farthest():
    rule = {
        "exact": {"low": 0.4, "high": 0.6, "other": None},
        "per_seed": [
            {"low": 0.41, "high": 0.62, "other": None},
            {"low": None, "high": 0.59, "other": 0.5},
        ],
    }
    found = rows(rule)
    assert found[0] == Row("low", 0.4, 0.41, None)
    assert found[1].farthest == 0.62
    assert found[2] == Row("other", None, 0.5, 0.5)
    assert rows(None) == []
    with console.capture() as printed:
        print_rule(rule)
    low = printed.get().splitlines()[1].split()
    assert low == ["low", "0.4000", "0.4100", "none"]
