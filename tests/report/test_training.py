"""Reports from synthetic data: a real, coarse solution of the pendulum with noise put on top, and a
market whose exact policy stays within a region."""

import errno
import io
import math
import os
import re
from dataclasses import replace
from functools import lru_cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.patches import Rectangle
from PIL import Image

from qfolio.agents.dqn import DQN
from qfolio.agents.pathwise import Pathwise
from qfolio.core.arrays import Floats
from qfolio.core.market import View
from qfolio.core.mdp import Box, Position
from qfolio.experiments.presets import preset
from qfolio.experiments.run import Run, train
from qfolio.portfolio.synthetic.garleanu_pedersen import GarleanuPedersen, Signals
from qfolio.portfolio.synthetic.no_trade import NoTrade
from qfolio.portfolio.synthetic.regime import Regime
from qfolio.report.animation import FADE_FRAMES, SIZE, pendulum_frames, pendulum_gif
from qfolio.report.collect import constant_weights, report_data, responses
from qfolio.report.data import (
    Curve,
    Episode,
    Maps,
    MarketData,
    ReportData,
    Responses,
    Weights,
    decimals,
)
from qfolio.report.figures.curves import (
    DECADES,
    LEAST_REGRET,
    draw_learning_curve,
    draw_overestimation,
)
from qfolio.report.figures.pendulum import draw_value
from qfolio.report.figures.policies import draw_policy
from qfolio.report.training import (
    duration,
    large,
    number,
    percent,
    render_page,
    setting_groups,
    verdict,
    write_report,
)
from qfolio.tasks.catch import Catch

DISCOUNT = 0.98
ANGLES = np.linspace(-np.pi, np.pi, 61)
SPEEDS = np.linspace(-8, 8, 61)
TORQUES = np.linspace(-2, 2, 5)


def _step(angle: Floats, speed: Floats, torque: Floats) -> tuple[Floats, Floats, Floats]:
    wrapped = (angle + np.pi) % (2 * np.pi) - np.pi
    reward = -(wrapped**2 + 0.1 * speed**2 + 0.001 * torque**2)
    speed = np.clip(speed + (15 * np.sin(angle) + 3 * torque) * 0.05, -8, 8)
    return angle + speed * 0.05, speed, reward


def _interpolate(table: Floats, angle: Floats, speed: Floats) -> Floats:
    x = ((angle + np.pi) % (2 * np.pi)) / (2 * np.pi) * (len(ANGLES) - 1)
    y = (speed + 8) / 16 * (len(SPEEDS) - 1)
    i, j = np.minimum(x.astype(int), len(ANGLES) - 2), np.minimum(y.astype(int), len(SPEEDS) - 2)
    a, b = x - i, y - j
    return np.asarray(
        (1 - a) * (1 - b) * table[i, j]
        + a * (1 - b) * table[i + 1, j]
        + (1 - a) * b * table[i, j + 1]
        + a * b * table[i + 1, j + 1]
    )


def _lookahead(table: Floats, angle: Floats, speed: Floats) -> Floats:
    angle, speed, reward = _step(angle[..., None], speed[..., None], TORQUES)
    return reward + DISCOUNT * _interpolate(table, angle, speed)


@lru_cache
def solve() -> tuple[Floats, Floats]:
    """Return value and policy of the pendulum on the grid by value iteration."""
    angles, speeds = np.meshgrid(ANGLES, SPEEDS, indexing="ij")
    table = np.zeros_like(angles)
    for _ in range(150):
        table = _lookahead(table, angles, speeds).max(axis=-1)
    return table, TORQUES[_lookahead(table, angles, speeds).argmax(axis=-1)]


def make_episode(steps: int) -> Episode:
    table, _ = solve()
    states, torques, rewards = [np.array([np.pi - 0.3, 0.2])], [], []
    for _ in range(steps):
        torque = TORQUES[_lookahead(table, *states[-1][:, None]).argmax()]
        angle, speed, reward = _step(states[-1][0], states[-1][1], torque)
        states.append(np.array([angle, speed]))
        torques.append(torque)
        rewards.append(float(reward))
    return Episode(np.array(states), np.array(torques), np.array(rewards))


def make_maps() -> Maps:
    table, policy = solve()
    x, y = np.meshgrid(ANGLES, SPEEDS, indexing="ij")
    wobble = 3 * np.sin(2 * x + 0.4 * y) + 2.5 * np.cos(3 * x - 0.7 * y)
    learned = TORQUES[_lookahead(table + 0.4 * wobble, x, y).argmax(axis=-1)]
    return Maps(ANGLES, SPEEDS, table + wobble, learned, table, policy, DISCOUNT)


def make_curve(label: str, seeds: int, points: int, bias: float) -> Curve:
    rng = np.random.default_rng(7)
    progress = np.linspace(0, 1, points)[:, None]
    # Returns rise from very bad to near the optimum, each seed at its own pace.
    pace = rng.uniform(7, 14, seeds)
    noise = rng.normal(size=(points, seeds))
    returns = -140 - 1350 * np.exp(-pace * progress) - 6 * np.abs(noise) * (1.1 - progress)
    start = 120 * np.exp(-18 * progress)
    over = start + bias * (1 - np.exp(-4 * progress)) + 0.6 * bias * rng.normal(size=seeds) / 4
    over = over + rng.normal(size=(points, seeds)) * 0.8
    episodes = np.round(np.linspace(0, 400, points + 1)[1:]).astype(int)
    return Curve(label, episodes, returns, over)


def make_data(seeds: int = 8, points: int = 20, steps: int = 200) -> ReportData:
    curve = make_curve("double DQN", seeds, points, 1.2)
    returns = curve.returns[-1]
    rng = np.random.default_rng(11)
    episodes = np.tile(np.arange(1, 401), seeds)
    training = -165 - 1250 * np.exp(-episodes / 42) - 90 * rng.exponential(size=episodes.size)
    mean, spread = returns.mean(), 1.96 * returns.std() / np.sqrt(seeds)
    summary = {
        "task": "Pendulum",
        "agent": "dqn",
        "preset": "default",
        "seeds": seeds,
        "episodes": 400,
        "env_steps": 80_000,
        "seconds_compile": 6.4,
        "seconds_train": 41.7,
        "steps_per_second": 80_000 * seeds / 41.7,
        "return_mean": float(mean),
        "return_ci95": [float(mean - spread), float(mean + spread)] if seeds > 1 else None,
        "return_per_seed": returns.tolist(),
        "optimum": -136.9,
        "regret_per_seed": ((-136.9 - returns) / 136.9).tolist(),
        "overestimation_per_seed": curve.overestimation[-1].tolist(),
    }
    config = {
        "task": {"name": "Pendulum", "steps": 200, "torques": 5},
        "agent": {
            "double": True,
            "discount": DISCOUNT,
            "learning_rate": 1e-3,
            "hidden": [64, 64],
            "batch": 64,
            "buffer": 20_000,
            "epsilon": {"start": 1.0, "end": 0.05, "steps": 20_000},
            "target": {"kind": "soft", "rate": 0.005},
        },
        "seed": 0,
        "seeds": seeds,
        "episodes": 400,
        "device": "cpu",
        "versions": {"qfolio": "0.1.0", "python": "3.11.7", "numpy": "2.4.6"},
    }
    return ReportData(
        title="Deep Q-network on the inverted pendulum",
        command="qfolio train --preset default --seed 0\nqfolio train --resume runs/pendulum",
        summary=summary,
        config=config,
        curve=curve,
        comparison=make_curve("without double DQN", seeds, points, 6.5),
        training_done=episodes,
        training_returns=training,
        optimum=-137.4,
        maps=make_maps(),
        episode=make_episode(steps),
    )


class Tags(HTMLParser):
    """All start tags of a page with their attributes."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A full report whose title, label, command and one setting try to inject markup."""
    data = make_data(steps=30)
    attack = "<script>alert(1)</script>"
    assert data.comparison is not None
    data = replace(
        data,
        title=f"Title {attack}",
        command=f"qfolio train {attack}",
        config={**data.config, "note": attack, attack: {"depth": 1}},
        comparison=replace(data.comparison, label=f"$x$ {attack}"),
    )
    folder = tmp_path_factory.mktemp("new") / "report"
    write_report(folder, data)
    return folder


@pytest.fixture(scope="module")
def page(folder: Path) -> str:
    return (folder / "report.html").read_text(encoding="utf-8")


def test_files(folder: Path) -> None:
    names = {path.name for path in folder.iterdir()}
    assert names == {"report.html", "learning_curve.png", "value.png", "episode.gif"}
    for name in ("learning_curve.png", "value.png"):
        with Image.open(folder / name) as image:
            assert image.width > 1000
            assert image.convert("RGB").getpixel((0, 0)) == (255, 255, 255)


def test_everything_is_escaped(page: str) -> None:
    assert "<script" not in page
    assert page.count("&lt;script&gt;alert(1)&lt;/script&gt;") >= 6


def test_page_needs_no_other_file(page: str) -> None:
    assert "http:" not in page
    assert "https:" not in page
    assert "@import" not in page
    tags = Tags(page).found
    assert not {"script", "link", "iframe", "object"} & {tag for tag, _ in tags}
    for _, attributes in tags:
        for name in ("src", "href", "xlink:href", "srcset"):
            target = attributes.get(name) or "#"
            assert target.startswith(("#", "data:image/"))
    policies = [a["content"] for _, a in tags if a.get("http-equiv") == "Content-Security-Policy"]
    assert len(policies) == 1
    assert str(policies[0]).startswith("default-src 'none'")


def test_identifiers_are_unique_and_found(page: str) -> None:
    identifiers = [a["id"] for _, a in Tags(page).found if "id" in a]
    assert len(identifiers) == len(set(identifiers))
    assert set(re.findall(r"url\(#([^)]+)\)", page)) <= set(identifiers)


def test_figures_follow_the_colors_of_the_page(page: str) -> None:
    figures = "".join(re.findall(r"<svg.*?</svg>", page, flags=re.DOTALL))
    assert "var(--accent)" in figures
    assert "exact optimum \N{MINUS SIGN}137.4" in figures
    assert "#0b63a5" not in figures


def test_style_of_matplotlib_is_left_alone(folder: Path) -> None:
    assert folder.exists()
    assert mpl.rcParams["svg.fonttype"] == mpl.rcParamsDefault["svg.fonttype"]


def test_page_is_repeatable() -> None:
    data = replace(make_data(seeds=3, points=5, steps=1), maps=None, episode=None)
    assert render_page(data) == render_page(data)


def test_one_seed_one_evaluation_and_no_extras(tmp_path: Path) -> None:
    for name in ("value.png", "policy.png", "episode.gif"):
        (tmp_path / name).write_bytes(b"from an earlier report")
    data = make_data(seeds=1, points=1, steps=2)
    write_report(tmp_path, replace(data, comparison=None, maps=None, episode=None))
    assert {path.name for path in tmp_path.iterdir()} == {"report.html", "learning_curve.png"}
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "One agent reached" in page
    assert "no interval" in page
    assert "95" not in page.split("<h2>Learning curve")[1].split("Terms")[0].split("<svg")[0]
    assert "The learned policy" not in page
    assert "without double DQN" not in page


def test_value_needs_maps() -> None:
    with pytest.raises(ValueError, match="maps"):
        draw_value(replace(make_data(steps=1), maps=None), 7.2)


def test_a_full_disk_leaves_the_earlier_report(tmp_path, monkeypatch):
    def full(file):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    write_report(tmp_path, make_data(steps=1))
    earlier = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space") as error:
        write_report(tmp_path, make_data(steps=2))
    assert error.value.filename == str(tmp_path / "learning_curve.png")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == earlier


def test_gif_has_every_step_and_repeats() -> None:
    episode = make_episode(25)
    content = pendulum_gif(episode.states, episode.torques, episode.rewards)
    with Image.open(io.BytesIO(content)) as gif:
        assert gif.n_frames == 26 + FADE_FRAMES  # type: ignore[attr-defined]
        assert gif.info["loop"] == 0
        assert gif.info["duration"] == 50
        assert gif.size == (SIZE, SIZE)
        assert gif.convert("RGB").getpixel((1, 1)) == (255, 255, 255)
        gif.seek(25)
        assert gif.info["duration"] > 500


def test_pendulum_is_drawn_as_gymnasium_does() -> None:
    # A quarter turn counter-clockwise from upright points to the left.
    states = [[0.0, 0.0], [np.pi / 2, 0.0], [np.pi, 0.0]]
    frames = pendulum_frames(states, [0.0, 0.0], [-1.0, -1.0])
    bobs = [_center_of(frame, (11, 99, 165)) for frame in frames]
    np.testing.assert_allclose(bobs, [(160, 45), (62, 143), (160, 241)], atol=1.5)


def test_arrow_shows_the_torque() -> None:
    def colored(torque: float, color: tuple[int, int, int]) -> int:
        frame = pendulum_frames([[0.0, 0.0]] * 2, [torque], [0.0])[0]
        return int(np.all(np.asarray(frame) == color, axis=-1)[80:].sum())

    blue, orange = (11, 99, 165), (196, 87, 10)
    assert colored(2.0, blue) > colored(1.0, blue) > colored(0.0, blue) == 0
    assert colored(-2.0, orange) > colored(-1.0, orange) > colored(2.0, orange) == 0


def test_episode_of_wrong_shape() -> None:
    with pytest.raises(ValueError, match="do not fit an episode"):
        pendulum_frames(np.zeros((3, 2)), np.zeros(3), np.zeros(3))


def _center_of(frame: Image.Image, color: tuple[int, int, int]) -> tuple[float, float]:
    rows, columns = np.nonzero(np.all(np.asarray(frame) == color, axis=-1))
    return float(columns.mean()), float(rows.mean())


def test_verdict() -> None:
    summary = {
        "return_per_seed": [-140.0, -142.0],
        "return_mean": -141.0,
        "return_ci95": None,
        "optimum": -136.9,
        "regret_per_seed": [0.02, 0.04],
    }
    text = verdict(summary).replace("\N{MINUS SIGN}", "-")
    assert text == (
        "Two agents reached a mean return of -141.0 (2 seeds, -142.0 to -140.0), "
        "3.0% below the exact optimum of -136.9."
    )
    known = {**summary, "return_per_seed": [-141.0] * 5, "return_ci95": [-142.0, -140.0]}
    assert "(95% interval \N{MINUS SIGN}142.0 to" in verdict(known)
    assert "above the exact" in verdict({**summary, "regret_per_seed": [-0.01, -0.02]})
    zero = {**summary, "optimum": 0.0, "regret_per_seed": [math.inf, math.inf]}
    assert verdict(zero).endswith("), where the exact optimum is 0.0.")
    assert "equal to the exact" in verdict({**summary, "regret_per_seed": [1e-5, -1e-5]})
    assert verdict({**summary, "return_per_seed": [0.0] * 64}).startswith("64 agents")


def test_numbers() -> None:
    space, minus = "\N{NARROW NO-BREAK SPACE}", "\N{MINUS SIGN}"
    assert number(-1234.56) == f"{minus}1,234.6"
    assert number(-0.01) == "0.0"
    assert number(0.5, 2, sign=True) == "+0.50"
    assert percent(0.0314) == "3.1%"
    assert large(15_348.2) == "15,348"
    assert large(12_345_678) == "12.35 million"
    assert duration(6.44) == f"6.4{space}s"
    assert duration(119.6) == f"2{space}min"
    assert duration(3725) == f"1{space}h 2{space}min"


def test_setting_groups() -> None:
    config = {"b": {"c": {"d": [1, 2]}, "e": None}, "a": True, "f": Path("x")}
    assert setting_groups(config) == [
        ("general", [("a", "true"), ("f", "x")]),
        ("b", [("c.d", "[1, 2]"), ("e", "null")]),
    ]


def test_settings_that_differ_from_the_preset_come_first() -> None:
    data = replace(make_data(seeds=1, points=3, steps=1), maps=None, episode=None)
    assert "All settings of this training. general" in text_of(render_page(data))
    same = text_of(render_page(replace(data, preset="fast")))
    assert "They are those of the preset fast. general" in same
    changes = {
        "budget": ("9 steps", "8 episodes"),
        "hidden": ([4, 4], [8]),
        "double": (True, False),
    }
    text = text_of(render_page(replace(data, preset="<fast>", changes=changes)))
    assert (
        "Those that differ from the preset &lt;fast&gt; come first. "
        "changed budget 9 steps instead of 8 episodes hidden [4, 4] instead of [8] "
        "double true instead of false general"
    ) in text


LOW, HIGH = 0.41, 0.59
HELD = np.linspace(0, 1, 101)


def make_market(seeds: int = 3) -> ReportData:
    """A run of an agent without action values, whose seeds have found edges of their own."""
    edges = np.array([[LOW, HIGH], [0.40, 0.60], [0.45, 0.58]])[:seeds]
    learned = np.stack([np.clip(HELD, *ends) for ends in edges])[:, None]
    returns = 0.19 - 0.15 * np.exp(-np.arange(10.0))[:, None] - 0.0004 * np.arange(seeds)
    nothing = np.full(returns.shape, np.nan)
    summary = {
        "task": "market/no-trade",
        "agent": "pathwise",
        "preset": None,
        "seeds": seeds,
        "episodes": 640,
        "env_steps": 307_200,
        "seconds_compile": 3.0,
        "seconds_train": 4.0,
        "steps_per_second": 230_400.0,
        "return_mean": 0.19055,
        "return_ci95": [0.1891, 0.1915] if seeds > 1 else None,
        "return_per_seed": [0.1914, 0.19057, 0.18968][:seeds],
        "optimum": 0.19197,
        "regret_per_seed": [0.003, 0.0073, 0.0119][:seeds],
        "overestimation_per_seed": [None] * seeds,
        "rule": {
            "exact": {"low": LOW, "high at -0.2": HIGH},
            "per_seed": [{"low": a, "high at -0.2": b} for a, b in edges],
        },
    }
    return ReportData(
        title="Pathwise gradients in a market",
        command="qfolio train market/no-trade",
        summary=summary,
        config={"seed": 0},
        curve=Curve("greedy return", 64 * np.arange(10), returns, nothing),
        comparison=None,
        training_done=np.array([]),
        training_returns=np.array([]),
        optimum=0.1903,
        maps=None,
        episode=None,
        market=MarketData(
            about="One asset grows faster than cash.",
            measure="log growth",
            meaning="",
            rule="Low and high are the edges.",
            horizon=480,
            period="year",
            periods=40.0,
            policy=Responses(
                scenes=("at any time",),
                held=HELD,
                exact=np.clip(HELD, LOW, HIGH)[None],
                learned=learned,
                weights=True,
                region=(LOW, HIGH),
            ),
        ),
    )


def text_of(page: str) -> str:
    """What is to be read: a space for each tag, figures and style left out."""
    page = re.sub(r"<(svg|style).*?</\1>", "", page, flags=re.DOTALL)
    page = page.replace("\N{MINUS SIGN}", "-")
    return " ".join(re.sub(r"<[^>]*>", " ", page).split())


def test_market_report(tmp_path: Path) -> None:
    for name in ("value.png", "episode.gif"):
        (tmp_path / name).write_bytes(b"from an earlier report")
    write_report(tmp_path, make_market())
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"report.html", "learning_curve.png", "policy.png"}
    text = text_of((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert "Three agents reached a mean log growth of 0.1905 over 480 steps (95% interval" in text
    assert "0.7% below the exact optimum of 0.1920" in text
    assert "Growth a year 0.476% exact policy: 0.480%" in text
    assert "low 0.410 0.420 0.450" in text  # exact, mean, farthest
    assert "high at -0.2 0.590 0.590 0.600" in text
    assert "3 0.1897 1.19% Mean" in text
    assert "In the shaded region the exact policy does not trade" in text
    for word in ("pendulum", "torque", "swing", "estimation", "Epsilon", "Gray", "None", "nan"):
        assert word not in text, word


def test_market_where_the_best_is_to_earn_nothing() -> None:
    """The curve stays in view, although no share of the optimum can be missed."""
    market = make_market()
    summary = {**market.summary, "optimum": 0.0, "regret_per_seed": None}
    curve = replace(market.curve, returns=market.curve.returns - 0.2)
    market = replace(market, summary=summary, curve=curve, optimum=0.0)
    low, high = draw_learning_curve(market, 7.2).axes[0].get_ylim()
    assert low < curve.returns.min() < 0 < high
    text = text_of(render_page(market))
    assert ", where the exact optimum is 0." in text
    assert not re.search("Regret|None|nan", text)


def test_market_with_one_seed() -> None:
    text = text_of(render_page(make_market(seeds=1)))
    assert "low 0.410 0.410 high" in text
    assert "farthest" not in text.lower()


def test_market_compares_two_agents_that_estimate_values() -> None:
    data = make_market()
    values = replace(
        data.curve, label="all at once", overestimation=data.curve.returns * 0 - 0.0123
    )
    other = replace(values, label="one at a time", overestimation=data.curve.returns * 0 + 0.004)
    summary = {**data.summary, "overestimation_per_seed": [0.01, 0.02, 0.03]}
    page = render_page(replace(data, summary=summary, curve=values, comparison=other))
    curve = page[page.index('aria-label="Log growth over training') :]
    curve = curve[: curve.index("</figure>")]
    assert curve.count(">all at once<") == curve.count(">one at a time<") == 2  # wide and narrow
    text = text_of(page)
    assert "excess is -0.012 for “all at once” and +0.004 for “one at a time”" in text
    assert "Epsilon" in text
    assert "Double DQN" not in text


def test_market_text_is_escaped() -> None:
    data, attack = make_market(), "<script>alert(1)</script>"
    assert data.market is not None
    assert isinstance(data.market.policy, Responses)
    drawn = replace(data.market.policy, scenes=(attack, attack))
    drawn = replace(drawn, exact=drawn.exact.repeat(2, 0), learned=drawn.learned.repeat(2, 1))
    rule = {"exact": {attack: 1.0}, "per_seed": [{attack: 1.0}] * 3}
    words: dict[str, Any] = dict.fromkeys(("about", "measure", "meaning", "rule"), attack)
    market = replace(data.market, **words, policy=drawn)
    page = render_page(replace(data, summary={**data.summary, "rule": rule}, market=market))
    assert "<script" not in page.lower()
    assert page.count("&lt;script&gt;alert(1)&lt;/script&gt;") >= 8


def test_policy_is_drawn_beside_the_exact_one() -> None:
    data = make_market()
    (axes,) = draw_policy(data, 7.2).axes
    heights = [np.asarray(line.get_ydata()) for line in axes.lines]
    lines = {tuple(np.round(y, 6)) for y in heights if len(y) > 2}
    assert data.market is not None
    drawn = data.market.policy
    assert isinstance(drawn, Responses)
    wanted = [drawn.exact[0], *drawn.learned[:, 0], drawn.learned[:, 0].mean(0)]
    assert lines == {tuple(np.round(line, 6)) for line in wanted}
    (region,) = axes.patches
    assert isinstance(region, Rectangle)
    assert region.get_x() == LOW
    assert region.get_width() == pytest.approx(HIGH - LOW)


def test_weights_are_drawn_beside_the_exact_ones() -> None:
    data = make_market()
    learned = np.array([[0.5, 0.4], [0.6, 0.2]])
    drawn = Weights(("one", "two"), np.array([0.55, 0.45]), learned)
    assert data.market is not None
    data = replace(data, market=replace(data.market, policy=drawn))
    (axes,) = draw_policy(data, 7.2).axes
    seeds, mean, exact = (np.asarray(line.get_xdata()).tolist() for line in axes.lines)
    assert sorted(seeds) == [0.2, 0.4, 0.5, 0.6]
    assert mean == pytest.approx([0.55, 0.3])
    assert exact == [0.55, 0.45]
    assert "One row per asset" in render_page(data)


def test_policy_needs_a_market() -> None:
    with pytest.raises(ValueError, match="policies of a market"):
        draw_policy(replace(make_market(), market=None), 7.2)


def test_a_beginner_far_off_does_not_hide_the_curve() -> None:
    data = make_market()
    returns = data.curve.returns.copy()
    returns[0] = -1e17
    far = draw_learning_curve(replace(data, curve=replace(data.curve, returns=returns)), 10.5)
    assert far.axes[0].get_ylim()[0] > -1
    low, high = far.axes[1].get_ylim()
    assert high <= 2 * 10**DECADES * low
    for panel in far.axes:
        assert any("off the scale" in text.get_text() for text in panel.texts)


def test_regret_is_drawn_on_a_logarithmic_scale() -> None:
    """By hand; a seed that does better than the optimum is drawn at the least regret."""
    data = make_data(seeds=1, points=3, steps=1)
    returns = np.array([[-300.0], [-110.0], [-99.0]])
    data = replace(data, curve=replace(data.curve, returns=returns), optimum=-100.0)
    whole, regret = draw_learning_curve(data, 10.5).axes
    (line,) = regret.lines
    np.testing.assert_allclose(np.asarray(line.get_ydata()), [2.0, 0.1, LEAST_REGRET])
    assert regret.get_yscale() == "log"
    assert [text.get_text().split()[-1] for text in regret.texts] == ["less"]
    legend = whole.get_legend()
    assert legend is not None
    assert "exact optimum \N{MINUS SIGN}100.0" in [text.get_text() for text in legend.texts]


@pytest.mark.parametrize("optimum", [math.nan, 0.0])
def test_no_regret_without_an_optimum_to_divide_by(optimum: float) -> None:
    assert len(draw_learning_curve(replace(make_data(steps=1), optimum=optimum), 10.5).axes) == 1


@pytest.mark.parametrize(
    ("unit", "label"), [("episodes", "training episodes"), ("steps", "environment steps")]
)
def test_curves_are_drawn_over_the_budget(unit: str, label: str) -> None:
    data = replace(make_data(seeds=2, points=3, steps=1), unit=unit)
    for draw in (draw_learning_curve, draw_overestimation):
        for axes in draw(data, 7.2).axes:
            assert axes.get_xlabel() == label


def test_two_numbers_for_the_optimum_are_explained() -> None:
    data = replace(make_data(seeds=1, points=3, steps=1), maps=None, episode=None)
    assert "so its optimum is a slightly different number" in render_page(data)
    same = replace(data, optimum=data.summary["optimum"])
    assert "slightly different" not in render_page(same)


def test_key_figures_count_all_seeds() -> None:
    data = make_data(seeds=8, points=3, steps=1)
    for unit, each in (("episodes", "400 episodes each"), ("steps", "80,000 steps each")):
        text = text_of(render_page(replace(data, unit=unit, maps=None, episode=None)))
        assert f"Environment steps 640,000 all seeds, {each}" in text
    summary = {**data.summary, "episodes_per_seed": [430, 400, 512]}
    text = text_of(render_page(replace(data, summary=summary, maps=None, episode=None)))
    assert "all seeds, 400 to 512 episodes each" in text
    one = replace(make_data(seeds=1, points=3, steps=1), maps=None, episode=None)
    assert "Environment steps 80,000 400 episodes Learning" in text_of(render_page(one))


def test_decimals() -> None:
    assert [decimals(x) for x in (0.19055, -137.3, 5.663, 0.0, math.nan)] == [4, 1, 3, 1, 1]
    assert decimals(0.0034, 2, least=2) == 4


PATHWISE = Pathwise(num_envs=2, rollout_length=5, hidden=(4, 4))
CHOOSER = DQN(num_envs=2, hidden=(4,), all_actions=True)


def test_curves_in_the_unit_of_the_budget() -> None:
    for unit, last in (("episodes", 4), ("steps", 16)):
        run = train(Catch(rows=5), DQN(num_envs=2, hidden=(4,)), **{unit: last})  # type: ignore[arg-type]
        data = report_data(run, run.summary(), None, "")
        own = preset("fast", "catch")
        assert data.preset == "fast"
        assert list(data.changes)[:2] == ["budget", "seeds"]
        assert data.changes["budget"] == (f"{last} {unit}", f"{own.episodes} episodes")
        assert data.changes["hidden"] == ([4], list(own.settings["hidden"]))
        assert data.changes["rows"] == (5, Catch(**own.task).rows)
        assert all(value != before for value, before in data.changes.values())
        assert data.unit == unit
        assert data.curve.done[[0, -1]].tolist() == [0, last]
        np.testing.assert_allclose(data.training_done, np.linspace(0, last, 5)[1:])


def test_a_market_is_collected() -> None:
    """Of a run before its first step."""
    run = Run.create(NoTrade(horizon=6, menu="grid:4"), CHOOSER, episodes=2, seeds=2)
    data = report_data(run, {"task": "market/no-trade", "agent": "dqn", "rule": None}, None, "")
    assert data.title == "DQN in a market with a no-trade region"
    assert data.curve.label == "all actions at once"
    assert data.market is not None
    assert data.market.about
    assert (data.market.measure, data.market.period) == ("log growth", "year")
    assert data.market.periods == pytest.approx(0.5)
    assert isinstance(data.market.policy, Responses)
    assert data.market.policy.learned.shape == (2, 1, 201)


@pytest.mark.parametrize(
    ("task", "agent"),
    [
        (NoTrade(), PATHWISE),
        (GarleanuPedersen(), PATHWISE),
        (Signals(), PATHWISE),
        (Regime(menu="grid:4"), CHOOSER),
    ],
)
def test_learned_and_exact_policies(task, agent) -> None:
    """Seed by seed as by hand."""
    keys = jax.random.split(jax.random.key(3), 2)
    seeds = [agent.weights(agent.init(task, key)) for key in keys]
    members = jax.tree.map(lambda *x: jnp.stack(x), *seeds)
    drawn = responses(task, agent, members, task.optimum().policy, "in {}")
    position = isinstance(task.actions, Box)
    if isinstance(task, NoTrade):
        assert drawn.region is not None
        np.testing.assert_allclose(drawn.exact[0], np.clip(drawn.held, *drawn.region), atol=1e-6)
    elif position:
        slopes = np.diff(drawn.exact) / np.diff(drawn.held)
        own = 0.6457 if isinstance(task, GarleanuPedersen) else 0.5523
        np.testing.assert_allclose(slopes, own, atol=1e-3)
    else:
        assert drawn.scenes == ("in bad", "in good")
        assert (drawn.exact == [[0], [1]]).all()
    for seed, weights in enumerate(seeds):
        for scene, (_, market) in enumerate(task.scenes()):
            for i in (0, 50, 200):
                held = jnp.array([drawn.held[i]], jnp.float32)
                others = jnp.zeros(task.actions.n - 1 if position else 0)
                holding = jnp.concatenate([held, others])
                if not position:
                    holding = task.hold(jnp.concatenate([1 - held, held]))
                view = task.observe(Position(market, holding))
                action = agent.policy(weights, View(view.features[None], view.holding[None]))[0]
                wanted = task.intent(Position(market, holding), action)[0 if position else -1]
                assert drawn.learned[seed, scene, i] == pytest.approx(float(wanted), abs=1e-5)


def test_weights_of_a_rule() -> None:
    rule = {"exact": {"weight of asset 1": 0.3, "weight of asset 2": 0.0}}
    drawn = constant_weights({**rule, "per_seed": [{"weight of asset 1": 0.2, "x": 0.1}]})
    assert drawn.names == ("asset 1", "asset 2")
    assert drawn.exact.tolist() == [0.3, 0.0]
    assert drawn.learned.tolist() == [[0.2, 0.1]]
