"""Presets on tables with few rows, such as five years of months."""

from qfolio.agents.paths import OnPaths
from qfolio.core import settings
from qfolio.experiments.presets import Preset
from qfolio.portfolio.task import Portfolio


def fitted(preset: Preset, rows: int, lag: int | None = None) -> Preset:
    """The preset with half its ``horizon``, if so many rows are too few for an episode.

    Paths that an agent differentiates through are at most an episode. Half instead of all that
    fits, so that episodes can begin at different rows. lag: default, that of the preset's task.
    """
    task = settings.convert(Portfolio, preset.task)
    horizon, window, kept = (
        task.get(name, getattr(Portfolio, name)) for name in ("horizon", "window", "lag")
    )
    half, odd = divmod(horizon, 2)
    if odd or horizon < rows - window - (kept if lag is None else lag):
        return preset
    agent, chosen = preset.build(), dict(preset.settings)
    if isinstance(agent, OnPaths) and agent.rollout_length > half:
        chosen["rollout_length"] = half
    return preset._replace(settings=chosen, task={**preset.task, "horizon": half})
