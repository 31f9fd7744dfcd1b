import pytest

from qfolio.portfolio.study.evidence import Active, Evidence
from qfolio.portfolio.study.pooling import Pooled, PooledSharpe, Pools
from qfolio.portfolio.study.verdict import verdicts

ACTIVE = {"growth": 0.01, "low": 0.0, "high": 0.02, "tracking_error": 0.02, "t": 1.0, "z": 1.0}


def pools(reference, alone, best, tables=("us", "eu")):
    """Pools with findings against the reference and its best rebalancing."""
    active = Active(reference=reference, information_ratio=0.5, **ACTIVE)
    known = Evidence(
        first="2001-01-02", last="2002-12-31", days=500, years=2.0, to_reference=active,
        to_rebalanced=active, baseline="momentum", sharpe=-0.1, sharpe_t=-0.5,
        sharpe_z=-0.5,
    )  # fmt: skip

    def pooled(growth, finding):
        return Pooled(
            growth=growth, low=growth - 0.01, high=growth + 0.01, z=100 * growth, p=0.01,
            p_holm=0.02, finding=finding, positive=1, worst="us",
        )  # fmt: skip

    return Pools(
        evidence=dict.fromkeys(tables, known),
        to_reference=pooled(0.03, alone),
        to_rebalanced=pooled(0.02, best),
        sharpe=PooledSharpe(difference=-0.1, z=-0.5, positive=0),
    )


@pytest.mark.parametrize(
    ("alone", "best", "first", "second"),
    [
        (
            "better",
            "better",
            "tilts beats equal-weight, however it is rebalanced, in growth after costs over 2 "
            "tables: the mean difference in annual log growth is +2.00%",
            "Against equal-weight itself, rebalanced as often as it may be: the mean difference "
            "in annual log growth is +3.00%",
        ),
        # On random walks, an agent that merely trades less grows more than daily equal weights.
        (
            "better",
            "none",
            "No evidence that tilts beats the best rebalancing of equal-weight in growth after "
            "costs over 2 tables: the mean difference in annual log growth is +2.00%",
            "It beats equal-weight itself, as trading less may do without any skill: the mean "
            "difference in annual log growth is +3.00%",
        ),
        (
            "worse",
            "none",
            "tilts falls short of equal-weight in growth after costs over 2 tables: the mean "
            "difference in annual log growth is +3.00%",
            "Against the best rebalancing of equal-weight: the mean difference in annual log "
            "growth is +2.00%",
        ),
        (
            "none",
            "none",
            "No evidence that tilts beats equal-weight in growth after costs over 2 tables: the "
            "mean difference in annual log growth is +3.00%",
            "Against the best rebalancing of equal-weight: the mean difference in annual log "
            "growth is +2.00%",
        ),
    ],
)
def test_equal_weights_count_as_beaten_only_at_every_speed(alone, best, first, second):
    said = verdicts({"tilts": pools("equal-weight", alone, best)})["tilts"]
    assert said[0].startswith(first)
    assert said[1].startswith(second)
    assert len(said) == 4
    assert said[3] == (
        "Its Sharpe ratio less that of each table’s best baseline, seen in hindsight, is −0.10 on "
        "average (Stouffer’s z −0.50); it is higher on 0 of 2 tables."
    )


def test_another_reference_has_one_speed():
    said = verdicts({"tilts": pools("fund", "better", "better")})["tilts"]
    assert said[0].startswith("tilts beats fund in growth after costs over 2 tables: ")
    assert len(said) == 3


def test_a_table_alone_is_named_and_not_pooled():
    assert verdicts({"tilts": pools("fund", "better", "better", ["us"])})["tilts"] == [
        "tilts beats fund in growth after costs on us: the difference in annual log growth is "
        "+3.00% (95% interval +2.00% to +4.00%); z is +3.00, corrected p = 0.020.",
        "Its Sharpe ratio less that of the best baseline, seen in hindsight, is −0.10 (z −0.50).",
    ]
