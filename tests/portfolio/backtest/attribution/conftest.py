import pytest

from planted import four_folds, planted


@pytest.fixture(scope="session")
def prices():
    return planted()


@pytest.fixture(scope="session")
def stretches(prices):
    return four_folds(prices)
