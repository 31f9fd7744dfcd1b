"""The report of a run: one self-contained HTML page, its figures and its animation."""

import base64
import io
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from qfolio.core.files import write_bytes, write_text
from qfolio.core.statistics import interquartile_mean
from qfolio.report.animation import pendulum_gif
from qfolio.report.data import MarketData, ReportData, decimals
from qfolio.report.figures import curves, pendulum, policies
from qfolio.report.figures.style import LEAD, WIDE, save_png, svgs
from qfolio.report.rendering import (
    changed_settings,
    counted,
    duration,
    large,
    number,
    over_seeds,
    percent,
    render,
    setting_groups,
    typeset,
)
from qfolio.report.rule import rows


def write_report(folder: Path, data: ReportData) -> None:
    """Write report.html, learning_curve.png and further figures into a folder.

    These are value.png if there are maps, policy.png if there is the policy of a market, and
    episode.gif if there is an episode; otherwise files of these names from an earlier report are
    removed, so that a folder never mixes two reports. The page needs no other file and no network.

    Args:
        folder: The folder to write to; created if missing.
        data: The data of the report.

    Raises:
        OSError: A file cannot be written.
        ValueError: The shapes of the episode do not match.
    """
    save_png(folder / "learning_curve.png", curves.draw_learning_curve, data, LEAD)
    for name, draw, applies in (
        ("value.png", pendulum.draw_value, data.maps is not None),
        ("policy.png", policies.draw_policy, _has_policy(data)),
    ):
        if applies:
            save_png(folder / name, draw, data, WIDE)
        else:
            (folder / name).unlink(missing_ok=True)
    animation, gif = folder / "episode.gif", None
    if data.episode is None:
        animation.unlink(missing_ok=True)
    else:
        episode = data.episode
        gif = pendulum_gif(episode.states, episode.torques, episode.rewards)
        write_bytes(animation, gif)
    write_text(folder / "report.html", render_page(data, gif))


def render_page(data: ReportData, gif: bytes | None = None) -> str:
    """Return the text of the page, with the bytes of the animation if there is one."""
    biases = _biases(data)
    return render(
        "training.html",
        data=data,
        summary=data.summary,
        market=data.market,
        measure=data.market.measure if data.market else "return",
        seeds=len(data.summary["return_per_seed"]),
        verdict=verdict(data.summary, data.market),
        facts=_facts(data.summary, data.market, data.unit),
        biases=[(label, number(bias, _bias_digits(data), sign=True)) for label, bias in biases],
        doubled=any("double DQN" in label for label, _ in biases),
        agents=_agents(data),
        rule=_rule(data.summary.get("rule")),
        settings=_settings(data),
        order=_order(data),
        gif=None if gif is None else _data_uri("image/gif", gif),
        still=None if gif is None else _data_uri("image/png", _first_frame(gif)),
        learning=svgs(curves.draw_learning_curve, data, LEAD),
        value=None if data.maps is None else svgs(pendulum.draw_value, data, WIDE),
        policy=svgs(policies.draw_policy, data, WIDE) if _has_policy(data) else None,
        overestimation=svgs(curves.draw_overestimation, data, WIDE) if biases else None,
    )


def verdict(summary: dict[str, Any], market: MarketData | None = None) -> str:
    """Return the result in one or two plain sentences."""
    count = len(summary["return_per_seed"])
    agents = counted(count, "agent")
    digits = _digits(summary)
    interval = f" ({_over_seeds(summary)})" if count > 1 else ""
    measure = market.measure if market else "return"
    span = f" over {number(market.horizon, 0)} steps" if market else ""
    mean = number(summary["return_mean"], digits)
    sentence = f"{agents} reached a mean {measure} of {mean}{span}{interval}{_distance(summary)}."
    if count == 1:
        sentence += " A single seed says nothing about the spread, so no interval is given."
    return sentence


def _over_seeds(summary: dict[str, Any]) -> str:
    digits = _digits(summary)
    values, interval = summary["return_per_seed"], summary["return_ci95"]
    return over_seeds(values, interval, lambda value: number(value, digits))


def _distance(summary: dict[str, Any]) -> str:
    """Return the distance of the result from the optimum, if that is known."""
    if summary["optimum"] is None:
        return ""
    optimum = number(summary["optimum"], _digits(summary))
    if not summary["optimum"]:
        return f", where the exact optimum is {optimum}"
    regret = _mean_regret(summary)
    share = percent(abs(regret))
    if share == percent(0):
        return f", equal to the exact optimum of {optimum} within a tenth of a percent"
    return f", {share} {'below' if regret >= 0 else 'above'} the exact optimum of {optimum}"


def _digits(summary: dict[str, Any]) -> int:
    """Return the decimals of a return."""
    return decimals(summary["return_mean" if summary["optimum"] is None else "optimum"])


def _facts(
    summary: dict[str, Any], market: MarketData | None, unit: str
) -> list[tuple[str, str, str]]:
    """Return the key figures: name, value and a remark."""
    seeds = len(summary["return_per_seed"])
    digits = _digits(summary)
    together = "all seeds together" if seeds > 1 else "while training"
    counts = summary.get("episodes_per_seed", [summary["episodes"]])
    done = " to ".join(large(x) for x in sorted({min(counts), max(counts)})) + " episodes"
    if seeds > 1:
        each = large(summary["env_steps"]) + " steps" if unit == "steps" else done
        done = f"all seeds, {each} each"
    speed = ("Steps per second", large(summary["steps_per_second"]), together)
    facts = [("Return", number(summary["return_mean"], digits), _over_seeds(summary))]
    if summary["optimum"] is not None:
        facts.append(("Exact optimum", number(summary["optimum"], digits), "on the same starts"))
    if summary["regret_per_seed"] is not None:
        regret = percent(_mean_regret(summary), 2 if market else 1)
        facts.append(("Regret", regret, "of the optimum"))
    facts += [
        (
            "Training time",
            duration(summary["seconds_train"]),
            f"and {duration(summary['seconds_compile'])} to compile",
        ),
        speed,
        (
            "Environment steps",
            large(seeds * summary["env_steps"]),
            done,
        ),
    ]
    if market:
        facts[0] = (market.measure.capitalize(), *facts[0][1:])
        facts[1] = (*facts[1][:2], "on the same random paths")
    if market and market.period:
        learned, best = (summary[name] / market.periods for name in ("return_mean", "optimum"))
        fine = decimals(100 * best, 3)
        exact = f"exact policy: {percent(best, fine)}"
        facts.remove(speed)
        facts.insert(3, (f"Growth a {market.period}", percent(learned, fine), exact))
    return facts


def _settings(data: ReportData) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return all settings by group; those that differ from the preset come first."""
    changed = [("changed", changed_settings(data.changes))] if data.changes else []
    return changed + setting_groups(data.config)


def _order(data: ReportData) -> str:
    """Return a sentence on the preset that settings are compared with."""
    if data.preset is None:
        return ""
    if not data.changes:
        return f"They are those of the preset {data.preset}."
    return f"Those that differ from the preset {data.preset} come first."


def _agents(data: ReportData) -> list[tuple[str, list[str]]]:
    """Return a row for each agent, and one for their mean: return, regret and overestimation."""
    summary = data.summary
    columns = [(summary["return_per_seed"], lambda x: number(x, _digits(summary)))]
    if summary["regret_per_seed"] is not None:
        regrets = summary["regret_per_seed"]
        columns.append((regrets, lambda x: percent(x, 2 if data.market else 1)))
    excess = summary["overestimation_per_seed"]
    if None not in excess:
        columns.append((excess, lambda x: number(x, _bias_digits(data), sign=True)))
    table = [[*map(write, values), write(float(np.mean(values)))] for values, write in columns]
    names = [*map(str, range(1, len(excess) + 1)), "Mean"]
    return [(name, list(row)) for name, *row in zip(names, *table, strict=True)]


def _rule(rule: dict[str, Any] | None) -> list[tuple[str, str, str, str]]:
    """Return the name of each number of a rule, its exact value, the mean and the farthest."""

    def say(value: float | None) -> str:
        return "none" if value is None else number(value, 3)

    return [(typeset(x.name), say(x.exact), say(x.mean), say(x.farthest)) for x in rows(rule)]


def _mean_regret(summary: dict[str, Any]) -> float:
    return float(np.mean(summary["regret_per_seed"]))


def _has_policy(data: ReportData) -> bool:
    return data.market is not None and data.market.policy is not None


def _biases(data: ReportData) -> list[tuple[str, float]]:
    """Return the last overestimation of each curve, if action values were estimated."""
    curves = [curve for curve in (data.curve, data.comparison) if curve]
    last = [(x.label, float(interquartile_mean(x.overestimation[-1]))) for x in curves]
    return last if all(np.isfinite(bias) for _, bias in last) else []


def _bias_digits(data: ReportData) -> int:
    """Return the decimals of an overestimation."""
    if data.market is None:
        return 2
    return decimals(max((abs(bias) for _, bias in _biases(data)), default=1.0), 2, least=2)


def _first_frame(gif: bytes) -> bytes:
    buffer = io.BytesIO()
    Image.open(io.BytesIO(gif)).save(buffer, format="PNG")
    return buffer.getvalue()


def _data_uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
