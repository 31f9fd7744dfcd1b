"""Weights and limits that projections are tested on."""

import jax
import numpy as np

from qfolio.portfolio.mandate.projection import Limits

ASSETS, CASES = 10, 60

KINDS = [(False, False), (False, True), (True, False), (True, True)]


def case(rng: np.random.Generator, short: bool, turnover: bool):
    """Wanted and held weights, and limits that some weights meet, most of them barely."""
    low = np.where(rng.random(ASSETS) < 0.3, rng.random(ASSETS) / 20, 0.0) - 0.3 * short
    high = np.maximum(low, 0.05 + 0.4 * rng.random(ASSETS))
    inside = rng.uniform(low, high)
    if not short:
        inside = low + (inside - low) * min(1, (0.99 - low.sum()) / (inside - low).sum())
    groups = 1.0 * (rng.random((4, ASSETS)) < 0.4)  # they overlap
    rows = np.concatenate([np.ones((1, ASSETS)), -np.ones((1, ASSETS)), groups, -groups])
    most = rows @ inside + 0.1 * rng.random(10) * (rng.random(10) < 0.7)
    most[rng.random(10) < 0.3] = np.inf
    held = 0.9 * rng.dirichlet(np.ones(ASSETS))
    gross = abs(inside).sum() * (1 + 0.1 * rng.random()) if short else np.inf
    limit = abs(inside - held).sum() * (1 + 0.2 * rng.random()) if turnover else np.inf
    wanted = rng.normal(size=ASSETS) / 2 if short else rng.dirichlet(np.full(ASSETS, 0.5))
    return wanted, held, Limits(low, high, rows, most, np.array(gross), np.array(limit))


def cases(seed: int, short: bool, turnover: bool):
    rng = np.random.default_rng(seed)
    made = [case(rng, short, turnover) for _ in range(CASES)]
    return made, jax.tree.map(lambda *x: np.stack(x), *made)
