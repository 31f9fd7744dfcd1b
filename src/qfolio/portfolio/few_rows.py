"""Presets on tables with few rows, such as five years of months."""

from qfolio.agents.paths import OnPaths
from qfolio.core import settings
from qfolio.experiments.presets import Preset, presets_of
from qfolio.portfolio.task import Portfolio


def fitted(preset: Preset, rows: int, lag: int | None = None) -> Preset:
    """The preset with a shorter ``horizon``, if so many rows are too few for an episode.

    It is a half or a third, and not all that fits, so that episodes can begin at different rows.
    Paths that an agent differentiates through become at most an episode. Lengths that the user has
    chosen, so that they are in none of qfolio's presets, are kept.

    lag: default, that of the preset's task.
    """
    usual = presets_of("portfolio", preset.agent).values()
    path, head = _path(preset)
    if path not in (length for length, _ in map(_path, usual)):
        return preset
    task = settings.convert(Portfolio, preset.task)
    horizon, window, kept = (
        task.get(name, getattr(Portfolio, name)) for name in ("horizon", "window", "lag")
    )
    most = rows - window - (kept if lag is None else lag) - 1
    lengths = (horizon // parts for parts in (1, 2, 3) if horizon % parts == 0)
    if any(each.task.get("horizon") == horizon for each in usual):
        horizon = next((length for length in lengths if head < length <= most), horizon)
    shorter = {"rollout_length": horizon} if path > horizon else {}
    return preset._replace(
        settings={**preset.settings, **shorter}, task={**preset.task, "horizon": horizon}
    )


def _path(preset: Preset) -> tuple[int, int]:
    """Steps of the paths that its agent differentiates through, and how many do not count.

    Both are 0 if it differentiates through none.
    """
    agent = preset.build()
    if not isinstance(agent, OnPaths):
        return 0, 0
    return agent.rollout_length, getattr(agent, "head", 0)
