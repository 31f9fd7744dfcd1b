"""Tables that hold the same prices are named, and tables that only look alike are not."""

import msgspec
import numpy as np

from qfolio.portfolio.study.twins import twins
from qfolio.portfolio.study.verdict import looks_sentence

from studies import study
from tables import price_table, random_walk, weekdays

ROWS = 400
VALUES = random_walk(ROWS, 4)
TABLE = price_table(VALUES, "ABCD")
SAID = (
    "one and two hold nearly the same prices: their returns on {} common dates have a correlation "
    "of {}, so that the pooled evidence counts the same days twice; leave one of them out."
)


def test_a_copy_that_is_rounded_or_in_another_order_is_a_twin():
    rounded = price_table(VALUES.round(2), "ABCD")
    assert twins({"one": TABLE, "two": rounded}) == [SAID.format(400, 1)]
    turned = price_table(VALUES[:, ::-1].round(1), "DCBA")
    (said,) = twins({"one": TABLE, "two": turned})
    assert said.startswith("one and two hold nearly the same prices")


def test_of_a_table_with_fewer_rows_and_of_one_with_an_asset_that_starts_late():
    weekly = TABLE.dates[::5]
    assert twins({"one": TABLE, "two": price_table(VALUES[::5] * 3, "ABCD", weekly)}) == [
        SAID.format(80, 1)
    ]
    late = VALUES.copy()
    late[:100, 2] = np.nan
    assert twins({"one": TABLE, "two": price_table(late, "ABCD")}) == [SAID.format(400, 1)]


def test_tables_that_are_no_twins():
    market = np.random.default_rng(5).normal(0, 0.02, (ROWS, 1)).cumsum(0)
    one, two = (price_table(random_walk(ROWS, 4, seed) * np.exp(market), "ABCD") for seed in (1, 2))
    assert twins({"one": one, "two": two}) == []  # as correlated as stocks are
    others = price_table(VALUES, "ABCE")
    later = price_table(VALUES, "ABCD", weekdays(ROWS, "2030-01-01"))
    flat = price_table(np.full_like(VALUES, 5.0), "ABCD")
    assert twins({"one": TABLE, "others": others, "later": later, "flat": flat}) == []
    # One asset that both have, and that moves more than the others.
    wild = random_walk(ROWS, 1, 3, volatility=0.3)
    alike = [
        price_table(np.hstack([wild, random_walk(ROWS, 2, seed, volatility=0.005)]), "ABC")
        for seed in (4, 5)
    ]
    assert twins({"one": alike[0], "two": alike[1]}) == []
    # Two halves of one table that overlap little.
    first, second = TABLE.between(0, 240), TABLE.between(180, 400)
    assert twins({"first": first, "second": second}) == []


def test_the_verdict_names_them():
    _, result = study(2)
    assert looks_sentence(result).endswith("no evidence.")
    named = msgspec.structs.replace(result, twins=["a and b are the same."])
    assert looks_sentence(named).endswith("no evidence. a and b are the same.")
