"""An episode of the pendulum as an animation that loops smoothly."""

import io
from collections.abc import Sequence
from itertools import pairwise
from math import cos, degrees, pi, sin

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image, ImageColor, ImageDraw, ImageFont

from qfolio.report import palette

SIZE = 320
FADE_FRAMES = 8
HOLD_MILLISECONDS = 1200
STEP_SECONDS = 0.05

_SCALE = 3
_CENTER = (160.0, 143.0)
_ROD = 98.0
_TRAIL = 14

_Font = ImageFont.FreeTypeFont | ImageFont.ImageFont


def pendulum_gif(states: ArrayLike, torques: ArrayLike, rewards: ArrayLike) -> bytes:
    """Return an episode of T steps as a GIF that plays in real time and repeats forever.

    The last frame is held for a moment and then fades into the first one: T + 1 + FADE_FRAMES
    frames in all.

    Args:
        states: Angle (radians, 0 = upright, counter-clockwise positive) and angular speed,
            shape (T + 1, 2).
        torques: Torques in N m, counter-clockwise positive, shape (T,).
        rewards: Rewards, shape (T,).

    Raises:
        ValueError: The shapes do not match.
    """
    frames = pendulum_frames(states, torques, rewards)
    step = round(1000 * STEP_SECONDS)
    durations = [step] * (len(frames) - 1) + [HOLD_MILLISECONDS] + [step] * FADE_FRAMES
    frames += _fade(frames[-1], frames[0])
    table = _color_table()
    indexed = [frame.quantize(palette=table, dither=Image.Dither.NONE) for frame in frames]
    gif = io.BytesIO()
    indexed[0].save(
        gif,
        format="GIF",
        save_all=True,
        append_images=indexed[1:],
        duration=durations,
        loop=0,
        optimize=False,
    )
    return gif.getvalue()


def pendulum_frames(states: ArrayLike, torques: ArrayLike, rewards: ArrayLike) -> list[Image.Image]:
    """Return the T + 1 pictures of an episode, SIZE x SIZE pixels each; see pendulum_gif."""
    angles, torques, totals = _checked(states, torques, rewards)
    font = ImageFont.load_default(size=13 * _SCALE)
    background = _background()
    frames = []
    for number, (angle, torque, total) in enumerate(zip(angles, torques, totals, strict=True)):
        image = background.copy()
        pen = ImageDraw.Draw(image)
        _draw_trail(pen, angles[max(0, number - _TRAIL) : number + 1])
        _draw_torque(pen, angle, torque)
        _draw_pendulum(pen, angle)
        _draw_caption(pen, font, number * STEP_SECONDS, total, number / max(1, len(angles) - 1))
        frames.append(image.reduce(_SCALE))
    return frames


def _checked(
    states: ArrayLike, torques: ArrayLike, rewards: ArrayLike
) -> tuple[list[float], list[float], list[float]]:
    """Return angles, torques and cumulative returns, each with one number per frame."""
    state, torque, reward = (np.asarray(a, dtype=float) for a in (states, torques, rewards))
    steps = len(torque)
    if state.shape != (steps + 1, 2) or torque.shape != (steps,) or reward.shape != (steps,):
        shapes = f"{state.shape}, {torque.shape} and {reward.shape}"
        raise ValueError(f"states, torques and rewards of shapes {shapes} do not fit an episode")
    totals = np.concatenate([[0.0], np.cumsum(reward)])
    return state[:, 0].tolist(), [*torque.tolist(), 0.0], totals.tolist()


def _background() -> Image.Image:
    image = Image.new("RGB", (SIZE * _SCALE, SIZE * _SCALE), palette.PAPER)
    pen = ImageDraw.Draw(image)
    pen.ellipse(_box(*_CENTER, _ROD), outline=palette.HAIRLINE, width=_SCALE)
    # The goal: a short mark where the bob stands upright.
    x, y = _CENTER
    _line(pen, [(x, y - _ROD - 19), (x, y - _ROD - 28)], palette.MUTED, 1.4)
    return image


def _draw_trail(pen: ImageDraw.ImageDraw, angles: Sequence[float]) -> None:
    """Draw the bob's recent path, fading away."""
    parts = list(pairwise(angles))
    for age, (a, b) in zip(range(len(parts), 0, -1), parts, strict=True):
        share = 0.6 * (1 - age / (_TRAIL + 1)) ** 1.5
        _arc(pen, _ROD, a, b, palette.mix(palette.HAIRLINE, palette.ACCENT, share), 1 + 7 * share)


def _draw_torque(pen: ImageDraw.ImageDraw, angle: float, torque: float) -> None:
    """Draw a curved arrow from the rod in the direction of the torque."""
    if abs(torque) < 0.02:
        return
    color = palette.ACCENT if torque > 0 else palette.SECOND
    radius, side = 0.5 * _ROD, 1 if torque > 0 else -1
    end = angle + torque * 0.6
    head = side * min(0.2, 0.6 * abs(torque))
    _arc(pen, radius, angle, end - 0.7 * head, color, 3.4)
    tip, base = _at(radius, end), end - head
    wings = [_at(radius + w, base) for w in (-6.5, 6.5)]
    pen.polygon(_pixels([tip, *wings]), fill=color)


def _draw_pendulum(pen: ImageDraw.ImageDraw, angle: float) -> None:
    tip = _at(_ROD, angle)
    _line(pen, [_CENTER, tip], palette.INK, 5)
    pen.ellipse(_box(*_CENTER, 6), fill=palette.INK)
    pen.ellipse(_box(*_CENTER, 2.4), fill=palette.PAPER)
    pen.ellipse(_box(*tip, 13), fill=palette.ACCENT)


def _draw_caption(
    pen: ImageDraw.ImageDraw, font: _Font, seconds: float, total: float, progress: float
) -> None:
    left, right, y = 24.0, SIZE - 24.0, 296.0
    _line(pen, [(left, y - 16), (right, y - 16)], palette.HAIRLINE, 1.4)
    _line(pen, [(left, y - 16), (left + progress * (right - left), y - 16)], palette.MUTED, 1.4)
    end = _number(pen, font, left, y, f"{seconds:.2f}")
    _text(pen, font, end + 4, y, "s", "ls")
    text = f"{total:.1f}"
    _number(pen, font, right - _width(text), y, text)
    _text(pen, font, right - 56, y, "return", "rs")


def _number(pen: ImageDraw.ImageDraw, font: _Font, x: float, y: float, text: str) -> float:
    """Draw a number with digits of equal width, so that it does not jitter; return its end."""
    for letter in text:
        if letter == "-":  # The font has no minus sign, and a hyphen is too short.
            _line(pen, [(x + 0.8, y - 4.6), (x + 6.9, y - 4.6)], palette.INK, 1.3)
        else:
            _text(pen, font, x + _width(letter) / 2, y, letter, "ms", palette.INK)
        x += _width(letter)
    return x


def _width(text: str) -> float:
    return sum(3.9 if letter == "." else 7.7 for letter in text)


def _text(
    pen: ImageDraw.ImageDraw,
    font: _Font,
    x: float,
    y: float,
    text: str,
    anchor: str,
    color: str = palette.MUTED,
) -> None:
    pen.text((x * _SCALE, y * _SCALE), text, fill=color, font=font, anchor=anchor)


def _at(radius: float, angle: float) -> tuple[float, float]:
    """Return the point of the image at an angle, as Gymnasium draws it."""
    return _CENTER[0] - radius * sin(angle), _CENTER[1] - radius * cos(angle)


def _arc(
    pen: ImageDraw.ImageDraw, radius: float, a: float, b: float, color: str, width: float
) -> None:
    # Pillow measures clockwise from three o'clock.
    start, end = sorted(degrees(-angle - pi / 2) for angle in (a, b))
    box = _box(*_CENTER, radius + width / 2)
    pen.arc(box, start, end, fill=color, width=round(width * _SCALE))


def _line(
    pen: ImageDraw.ImageDraw, points: Sequence[tuple[float, float]], color: str, width: float
) -> None:
    pen.line(_pixels(points), fill=color, width=round(width * _SCALE))


def _pixels(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    return [(x * _SCALE, y * _SCALE) for x, y in points]


def _box(x: float, y: float, radius: float) -> tuple[float, float, float, float]:
    return tuple(_SCALE * v for v in (x - radius, y - radius, x + radius, y + radius))  # type: ignore[return-value]


def _fade(last: Image.Image, first: Image.Image) -> list[Image.Image]:
    shares = np.arange(1, FADE_FRAMES + 1) / (FADE_FRAMES + 1)
    return [Image.blend(last, first, float(share)) for share in shares]


def _color_table() -> Image.Image:
    """Return an image whose palette runs from paper to each color in even steps."""
    # Shades too close to paper would replace it, and the background must stay pure.
    steps = {palette.INK: 20, palette.MUTED: 12, palette.HAIRLINE: 3}
    steps |= {palette.ACCENT: 20, palette.SECOND: 16}
    shades = [
        ImageColor.getrgb(palette.mix(palette.PAPER, color, step / count))
        for color, count in steps.items()
        for step in range(count + 1)
    ]
    table = Image.new("P", (1, 1))
    table.putpalette([part for shade in dict.fromkeys(shades) for part in shade])
    return table
