"""The page about the papers' settings: they fit the agents, and the defaults are as it says."""

import re
from pathlib import Path

import pytest

from qfolio.core import settings
from qfolio.core.registry import AGENTS, find

PAGE = (Path(__file__).parents[2] / "docs" / "appendix" / "papers.md").read_text()
PAPERS = dict(re.findall(r"^## ([\w-]+): [^\n]*\n\n(.*?)\n\n", PAGE, re.DOTALL | re.MULTILINE))
TABULAR = {"q-learning", "sarsa", "expected-sarsa", "double-q", "dyna-q"}


def test_every_agent_with_networks_and_a_paper_is_there():
    own = {"pathwise", "tilts", "mean-variance-learned", "minimum-variance-learned"}
    assert PAPERS.keys() == AGENTS.keys() - TABULAR - own


@pytest.mark.parametrize("agent", PAPERS)
def test_papers_and_defaults(agent):
    rows = re.findall(r"\| `(\w+)` \| (\S+) \| (\S+) \|", PAPERS[agent])
    assert len(rows) == PAPERS[agent].count("\n") - 1, "every row of the table is read"
    kind = find("agent", agent)
    paper = {name: value for name, value, _ in rows}
    assert settings.describe(settings.build(kind, paper)) != settings.describe(kind())
    default = settings.convert(kind, {name: value for name, _, value in rows})
    assert {name: getattr(kind(), name) for name in default} == default
