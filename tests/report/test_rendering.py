from qfolio.report.rendering import typeset, years


def test_years_are_named_once_if_they_are_the_same() -> None:
    assert years("1990-01-02", "2022-12-28") == "1990 to 2022"
    assert years("2001-03-07 04:28", "2001-12-19 05:19") == "2001"


def test_typeset_leaves_names_alone() -> None:
    text = typeset("double-q-2 is at −0.40% after 51,200 steps, q-learning 3,4")
    assert text.startswith("double-q-2 is at \N{MINUS SIGN}0.40% after 51")
    assert text.endswith("q-learning 3,4")
