from qfolio.report.rendering import years


def test_years_are_named_once_if_they_are_the_same() -> None:
    assert years("1990-01-02", "2022-12-28") == "1990 to 2022"
    assert years("2001-03-07 04:28", "2001-12-19 05:19") == "2001"
