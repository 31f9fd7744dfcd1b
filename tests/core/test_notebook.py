"""What objects show of themselves in a notebook."""

import math

from qfolio.core.notebook import ROWS, card


def test_everything_is_escaped():
    hostile = "<script>alert(1)</script>\x1b[2J"
    text = card(hostile, [hostile], [hostile], [[hostile]])
    assert "<script" not in text
    assert "\x1b" not in text
    assert text.count("&lt;script&gt;") == 4


def test_a_curve_needs_two_points():
    assert "<svg" not in card("t", [], curve=[1.0, math.nan])
    drawn = card("t", [], curve=[3.0, math.nan, 1.0, 2.0])
    assert 'points="0.0,2.0 80.0,34.0 160.0,18.0"' in drawn
    assert 'points="0.0,34.0 160.0,34.0"' in card("t", [], curve=[5.0, 5.0])


def test_long_tables_are_cut():
    text = card("t", [], ["n"], [[str(i)] for i in range(ROWS + 5)])
    assert text.count("<tr>") == 1 + ROWS
    assert "and 5 more" in text
