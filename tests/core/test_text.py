"""Names from files, made harmless."""

import codecs
import math

import pytest

from qfolio.core.text import (
    amount,
    closest,
    csv_cell,
    figure,
    four_digits,
    listed,
    near,
    plain_signs,
    printable,
    quote,
)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("A\x1b[31mB", r"A\x1b[31mB"),
        ("\u202eevil\u2069", r"\u202eevil\u2069"),
        ("a\nb\r\x85\u2028\x9b", r"a\nb\r\x85\u2028\x9b"),
        ("\ud800\ufeff", r"\ud800\ufeff"),
        ("95\N{NARROW NO-BREAK SPACE}% Société, 東京 \N{MINUS SIGN}", None),
    ],
)
def test_a_terminal_obeys_nothing(text: str, shown: str | None):
    assert printable(text) == (text if shown is None else shown)


def test_signs_outlive_an_encoding_without_them():
    codecs.register_error("plain", plain_signs)
    text = "−5.0% · 2 × 3 ≥ 1 – that’s é"
    assert text.encode("ascii", "plain") == b"-5.0% * 2 x 3 >= 1 - that's ?"
    assert "−é".encode("latin-1", "plain") == b"-\xe9"


def test_quotes_are_short():
    assert quote("x" * 99) == f"'{'x' * 59}…'"
    assert quote("\x1b") == r"'\x1b'"


def test_a_wrong_name_gets_advice():
    known = ["dqn", "PPO", "", *(f"number-{i}" for i in range(30))]
    assert near("dqm", known) == "did you mean dqn?"
    assert closest("dnq", ["dyna-q", "dqn"]) == "dqn", "of the same length"
    assert near("ppo", known) == "did you mean PPO?"
    assert closest("xyz", known) is None
    assert near("xyz", known[:2]) == "choose from dqn, PPO."
    assert near("xyz", []) == "there is none to choose from."
    assert near("xyz", known).endswith("number-16, …")


def test_zero_has_no_sign():
    assert [figure(x, "+.2%") for x in (-1e-9, 0.0, -0.5, 0.5)] == [
        "0.00%",
        "0.00%",
        "−50.00%",
        "+50.00%",
    ]
    assert [figure(x, ",.1f") for x in (-0.04, -1234.5, None, math.nan)] == [
        "0.0",
        "−1,234.5",
        "–",
        "–",
    ]
    assert [figure(x, "+.1%") for x in (math.inf, -math.inf)] == ["+∞%", "−∞%"]
    assert figure(math.inf, ",.2f") == "∞"


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (999.96, "1,000"),
        (999.94, "999.9"),
        (1234.4, "1,234"),
        (-12345.6, "−12,346"),
        (1.0, "1.000"),
        (0.5, "0.5"),
        (0.012345, "0.01235"),
        (0.0, "0"),
        (None, "–"),
        (math.nan, "–"),
    ],
)
def test_numbers_with_four_digits(value: float | None, text: str):
    assert four_digits(value) == text


def test_counts_and_lists():
    assert [amount(n, "row") for n in (0, 1, 2000)] == ["0 rows", "1 row", "2,000 rows"]
    assert [listed(list("abc")[:n], "or") for n in (1, 2, 3)] == ["a", "a or b", "a, b or c"]


@pytest.mark.parametrize(
    "text",
    [
        "=cmd|' /C calc'!A0",
        "+1",
        "-1",
        "@SUM(A1)",
        "\t=1",
        " =1",
        "\r=1",
        "＝1",
        "＋1",
        "－1",
        "＠A",
        "a;=1",
        "a\t@b",
    ],
)
def test_no_cell_is_a_formula(text: str):
    cell = csv_cell(text)
    assert cell.replace("'", "", 1) == text
    for part in cell.replace("\t", ";").replace("\r", ";").split(";"):
        assert part.strip()[:1] not in tuple("=+-@＝＋－＠")


def test_other_cells_stay_as_they_are():
    for value in ("A", "a-b", "2024-01-02", "it's", -1.5, 0, None):
        assert csv_cell(value) == value
