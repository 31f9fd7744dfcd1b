import dataclasses
import math
import re

import pytest

from qfolio.agents.dqn import DQN
from qfolio.agents.sac import SAC
from qfolio.core import registry, settings
from qfolio.core.errors import QfolioError
from qfolio.core.fields import number, static

from probes import OneState, Probe


def test_text_becomes_the_fields_type():
    agent = settings.build(
        DQN,
        {
            "hidden": "64,32",
            "discount": "0.5",
            "double": "False",
            "batch_size": "9",
            "huber_delta": "inf",
        },
    )
    assert (agent.hidden, agent.discount, agent.double) == ((64, 32), 0.5, False)
    assert (agent.batch_size, agent.huber_delta) == (9, math.inf)


def test_describe_and_build_are_inverse():
    agent = DQN(hidden=(7, 5), huber_delta=math.inf, discount=0.125)
    assert settings.build(DQN, settings.describe(agent)) == agent


@dataclasses.dataclass(frozen=True)
class Bounds:
    low: float = -math.inf
    high: float = math.inf
    levels: tuple[float, ...] = (-math.inf, 0.5)


def test_infinities_are_described_as_text():
    described = settings.describe(Bounds())
    assert described == {"low": "-inf", "high": "inf", "levels": ["-inf", 0.5]}
    assert settings.build(Bounds, described) == Bounds()


def test_parse():
    assert settings.parse(["a=1", "learning-rate = 2"]) == {"a": "1", "learning_rate": "2"}
    assert settings.parse(["my-agent.learning-rate=2"]) == {"my-agent.learning_rate": "2"}


@pytest.mark.parametrize("assignment", ["discount", "=1", "discount="])
def test_parse_says_what_it_wants(assignment):
    with pytest.raises(QfolioError, match="name=value"):
        settings.parse([assignment])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("discount", "much"), ("discount", "nan"), ("discount", None), ("batch_size", "1.5"),
        ("batch_size", True), ("hidden", "a,b"), ("hidden", [1.5]), ("double", "perhaps"),
        ("batch_size", "1e999"), ("hidden", {"a": 1}),
    ],
)  # fmt: skip
def test_refuses_what_does_not_fit(name, value):
    with pytest.raises(QfolioError, match=f"^{name} is "):
        settings.build(DQN, {name: value})


def test_unknown_names_get_a_suggestion():
    with pytest.raises(QfolioError, match="did you mean learning_rate"):
        settings.build(DQN, {"learning_rat": 1})


def refusal(kind, chosen):
    """What is said of settings that do not fit, and nothing of others."""
    try:
        settings.build(kind, chosen)
    except QfolioError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(
    ("kind", "name"),
    [("task", name) for name in registry.TASKS] + [("agent", name) for name in registry.AGENTS],
)
def test_a_range_that_is_named_includes_its_ends(kind, name):
    """Of a setting that must be above 0, nobody should read "from 0" or "between 0 and"."""
    found = registry.find(kind, name)
    numbers = [field.name for field in dataclasses.fields(found) if field.type in (int, float)]
    assert numbers
    ranges = 0
    for setting in numbers:
        for value in (0, 1, 100):
            said = refusal(found, {setting: value})
            if ends := re.search(r"(?:from|between) ([\d.,]+) (?:to|and) ([\d.,]+)", said):
                low, high = (float(end.rstrip(".").replace(",", "")) for end in ends.groups())
                assert not low <= value <= high, said
                ranges += 1
    assert ranges or name == "finite/frozen-lake"  # it has no number with two ends


def test_counts_shape_the_program():
    class Careless(OneState):
        size: int = 4

    with pytest.raises(QfolioError, match=r"size of Careless .*; declare it as size: int = static"):
        Careless()


def test_settings_are_divided_by_their_owners():
    parts = settings.divide({"discount": "0.5", "horizon": "3"}, OneState, DQN)
    assert parts == [{"horizon": "3"}, {"discount": "0.5"}]
    with pytest.raises(QfolioError, match=r"neither OneState nor DQN .* did you mean discount\?"):
        settings.divide({"discont": 1}, OneState, DQN)
    with pytest.raises(QfolioError, match=r"^DQN and SAC both have a setting 'discount', so that"):
        settings.divide({"discount": "0.5"}, DQN, SAC)


def test_a_setting_that_is_given_twice_is_refused():
    with pytest.raises(QfolioError, match=r"^--set names learning_rate twice; give it one value"):
        settings.parse(["learning_rate=1", "learning-rate=2"])
    assert len(settings.parse(["a-b.lambda=1", "b.lambda=2"])) == 2


def test_a_default_that_would_change_nothing_is_refused():
    """Python keeps the inherited default if a subclass gives a value without a type."""
    with pytest.raises(QfolioError, match=r"declare it as learning_rate: float = number\(…\)"):
        type("Own", (DQN,), {"learning_rate": 1e-5})()

    class Slow(DQN):
        learning_rate: float = number(1e-5)

    assert Slow().learning_rate == 1e-5


class Priced(Probe):
    """Its price has no default."""

    price: float
    horizon: int = static(1)
    reset, observe, step = OneState.reset, OneState.observe, OneState.step


def test_a_setting_without_a_default_has_to_be_set():
    assert settings.build(Priced, {"price": "2"}).price == 2.0
    with pytest.raises(
        QfolioError, match=r"^Priced needs price; give price a default in its class"
    ):
        settings.build(Priced, {})


def test_defaults_leave_out_what_has_none():
    whole = settings.describe(settings.build(Priced, {"price": 2.0}))
    assert settings.defaults(Priced, {"price": 2.0}) == whole
    assert settings.defaults(Priced, {}) == {k: x for k, x in whole.items() if k != "price"}
