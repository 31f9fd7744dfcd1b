"""Reports from synthetic data: a real, coarse solution of the pendulum with noise put on top."""

import io
import re
from dataclasses import replace
from functools import lru_cache
from html.parser import HTMLParser
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from qfolio.report import Curve, Episode, Maps, ReportData, write_report
from qfolio.report.animation import FADE_FRAMES, SIZE, pendulum_frames, pendulum_gif
from qfolio.report.figures import overestimation, value
from qfolio.report.page import (
    amount,
    duration,
    number,
    percent,
    render_page,
    setting_groups,
    verdict,
)

Floats = NDArray[np.float64]

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
        "env_steps": 80_000 * seeds,
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
        training_episodes=episodes,
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


def test_figures_follow_the_colours_of_the_page(page: str) -> None:
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
    for name in ("value.png", "episode.gif"):
        (tmp_path / name).write_bytes(b"from an earlier report")
    data = make_data(seeds=1, points=1, steps=2)
    write_report(tmp_path, replace(data, comparison=None, maps=None, episode=None))
    assert {path.name for path in tmp_path.iterdir()} == {"report.html", "learning_curve.png"}
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "One agent reached" in page
    assert "no interval" in page
    assert "95" not in page.split("How the return grew")[1].split("Terms")[0].split("<svg")[0]
    assert "What it learned" not in page
    assert "without double DQN" not in page


def test_overestimation_into_a_buffer() -> None:
    buffer = io.BytesIO()
    overestimation(buffer, make_data(seeds=2, points=3, steps=1))
    assert buffer.getvalue().startswith(b"\x89PNG")


def test_value_needs_maps() -> None:
    with pytest.raises(ValueError, match="maps"):
        value(io.BytesIO(), replace(make_data(steps=1), maps=None))


def test_gif_has_every_step_and_repeats() -> None:
    episode = make_episode(25)
    buffer = io.BytesIO()
    pendulum_gif(buffer, episode.states, episode.torques, episode.rewards)
    with Image.open(buffer) as gif:
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
    bobs = [_centre_of(frame, (11, 99, 165)) for frame in frames]
    np.testing.assert_allclose(bobs, [(160, 45), (62, 143), (160, 241)], atol=1.5)


def test_arrow_shows_the_torque() -> None:
    def coloured(torque: float, colour: tuple[int, int, int]) -> int:
        frame = pendulum_frames([[0.0, 0.0]] * 2, [torque], [0.0])[0]
        return int(np.all(np.asarray(frame) == colour, axis=-1)[80:].sum())

    blue, orange = (11, 99, 165), (196, 87, 10)
    assert coloured(2.0, blue) > coloured(1.0, blue) > coloured(0.0, blue) == 0
    assert coloured(-2.0, orange) > coloured(-1.0, orange) > coloured(2.0, orange) == 0


def test_episode_of_wrong_shape() -> None:
    with pytest.raises(ValueError, match="make no episode"):
        pendulum_frames(np.zeros((3, 2)), np.zeros(3), np.zeros(3))


def _centre_of(frame: Image.Image, colour: tuple[int, int, int]) -> tuple[float, float]:
    rows, columns = np.nonzero(np.all(np.asarray(frame) == colour, axis=-1))
    return float(columns.mean()), float(rows.mean())


def test_verdict() -> None:
    summary = {
        "return_per_seed": [-140.0, -142.0],
        "return_mean": -141.0,
        "return_ci95": [-142.0, -140.0],
        "optimum": -136.9,
        "regret_per_seed": [0.02, 0.04],
    }
    text = verdict(summary).replace("\N{NARROW NO-BREAK SPACE}", " ").replace("\N{MINUS SIGN}", "-")
    assert text == (
        "Two agents reached a mean return of -141.0 (95 % interval -142.0 to -140.0), "
        "3.0 % below the exact optimum of -136.9."
    )
    assert "above the exact" in verdict({**summary, "regret_per_seed": [-0.01, -0.02]})
    assert "equal to the exact" in verdict({**summary, "regret_per_seed": [1e-5, -1e-5]})
    assert verdict({**summary, "return_per_seed": [0.0] * 64}).startswith("64 agents")


def test_numbers() -> None:
    space, minus = "\N{NARROW NO-BREAK SPACE}", "\N{MINUS SIGN}"
    assert number(-1234.56) == f"{minus}1{space}234.6"
    assert number(-0.01) == "0.0"
    assert number(0.5, 2, sign=True) == "+0.50"
    assert percent(0.0314) == f"3.1{space}%"
    assert amount(15_348.2) == f"15{space}348"
    assert amount(12_345_678) == "12.35 million"
    assert duration(6.44) == f"6.4{space}s"
    assert duration(119.6) == f"2{space}min"
    assert duration(3725) == f"1{space}h 2{space}min"


def test_setting_groups() -> None:
    config = {"b": {"c": {"d": [1, 2]}, "e": None}, "a": True, "f": Path("x")}
    assert setting_groups(config) == [
        ("general", [("a", "true"), ("f", "x")]),
        ("b", [("c.d", "[1, 2]"), ("e", "null")]),
    ]
