"""Records of episodes are stored by column, and read and written like rows."""

import csv
import math

import jax.numpy as jnp
import numpy as np

from qfolio.core.training import Episodes
from qfolio.experiments.fit import _records
from qfolio.experiments.records import Records

ROWS = [{"seed": i % 2, "episode": 1 + i // 2, "return": i / 3} for i in range(6)]


def test_a_table_reads_like_its_rows():
    records = Records.of(iter(ROWS))
    assert records == ROWS
    assert list(records) == ROWS
    assert [type(value) for value in records[-1].values()] == [int, int, float]
    assert records[1:5:2] == ROWS[1:5:2]
    assert records[records.column("seed") == 1] == ROWS[1::2]
    assert records[np.array([4, 0])] == [ROWS[4], ROWS[0]]
    assert records != ROWS[:5]
    assert Records.joined([records[:2], Records(), records[2:]]) == ROWS


def test_no_rows_have_no_numbers():
    for empty in (Records(), Records.of([]), Records.joined([]), Records.of(ROWS)[:0]):
        assert not empty
        assert empty == []
        assert empty.column("return").shape == (0,)
        assert empty.csv(header=False) == b""


def test_a_table_is_written_with_all_digits():
    rows = [*ROWS, {"seed": 0, "episode": 4, "return": math.nan}]
    text = Records.of(rows[:3]).csv(header=True) + Records.of(rows[3:]).csv(header=False)
    again = [{k: float(v) for k, v in row.items()} for row in csv.DictReader(text.decode().split())]
    assert again[:-1] == ROWS
    assert text.decode().splitlines()[-1] == "0,4,nan"


def test_episodes_are_counted_for_each_member_in_order_of_time():
    """Against a count one by one, of members whose episodes end at random."""
    draw = np.random.default_rng(0)
    finished = draw.random((3, 40, 4)) < 0.3
    finished[1] = False
    returns = draw.normal(size=finished.shape).astype(np.float32)
    records, members, times = _records(
        [7, 8, 9], [10, 20, 30], Episodes(jnp.array(finished), jnp.array(returns), {})
    )
    count, expected, ends = [10, 20, 30], [], []
    for time, member, environment in np.ndindex(40, 3, 4):
        if finished[member, time, environment]:
            count[member] += 1
            ends.append(time)
            value = float(returns[member, time, environment])
            expected.append({"seed": 7 + member, "episode": count[member], "return": value})
    assert records == expected
    assert members == [row["seed"] - 7 for row in expected]
    assert times.tolist() == ends
