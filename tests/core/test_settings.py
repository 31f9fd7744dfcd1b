import dataclasses
import json
import math
import re
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest

from qfolio.agents.dqn import DQN
from qfolio.agents.sac import SAC
from qfolio.core import registry, settings
from qfolio.core.errors import QfolioError
from qfolio.core.fields import number, static
from qfolio.core.population import Population

from populations import assert_same, train_to
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


@pytest.mark.parametrize(
    ("kind", "value", "says"),
    [
        (str, "a", r"is text, which shapes the program; declare it as part: str = static\(…\)"),
        (bool, True, r"is true or false, which .*; declare it as part: bool = static\(…\)"),
        (Any, "a", r"is of type str, which .*; declare it as part: .*Any = static\(…\)"),
        (dict, {"sign": abs}, r"holds a function, which .*; declare it as part: dict = static"),
    ],
)
def test_what_is_no_number_shapes_the_program(kind, value, says):
    with pytest.raises(QfolioError, match=f"^part of Own {says}"):
        type("Own", (OneState,), {"__annotations__": {"part": kind}, "part": part(value)})()


def test_a_network_is_held_by_its_arrays():
    """As a static field its arrays would be constants, of which jax warns."""
    network = eqx.nn.MLP(2, 1, 4, 1, key=jax.random.key(0))
    own = type("Own", (OneState,), {"__annotations__": {"part": Any}, "part": part(network)})
    with pytest.raises(
        QfolioError, match=r"^part of Own holds a function, .*; keep its arrays, as"
    ):
        own()
    arrays, _ = eqx.partition(network, eqx.is_array)
    assert jax.tree.leaves(own(part=arrays).part)


def part(value):
    return dataclasses.field(default_factory=lambda: value)


def test_a_default_may_be_a_number_of_numpy():
    class Own(OneState):
        size: int = static(np.int64(3))
        share: float = number(np.float64(0.5))

    assert type(Own().share) is float
    described = settings.describe(Own())
    assert json.loads(json.dumps(described)) == {"horizon": 1, "size": 3, "share": 0.5}


class Composed(DQN):
    """Learns as a DQN that is made anew, or changed, within the program."""

    share: float = number(0.5)
    anew: bool = static(True)

    def learn(self, task, state, rollout, key):
        rate = self.learning_rate * self.share
        if self.anew:
            chosen: Any = {name: getattr(self, name) for name in settings.names(DQN)}
            return DQN(**{**chosen, "learning_rate": rate}).learn(task, state, rollout, key)
        return DQN.learn(dataclasses.replace(self, learning_rate=rate), task, state, rollout, key)


@pytest.mark.parametrize("anew", [True, False])
def test_agents_can_be_made_within_a_program(anew):
    small: Any = {"hidden": (4,), "batch_size": 4, "learning_starts": 4}
    agents = [Composed(**small, learning_rate=0.01, anew=anew), DQN(**small, learning_rate=0.005)]
    composed, plain = (train_to(Population(OneState(), agent, [0]), 50) for agent in agents)
    assert_same(jax.tree.leaves(composed.weights()), jax.tree.leaves(plain.weights()))


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
