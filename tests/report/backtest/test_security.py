"""What the page of a backtest must not do: run, load or show anything that is not its own."""

import base64
import hashlib
import re
from pathlib import Path

from qfolio.report.backtest.page import SCRIPTS, render_backtest
from qfolio.report.rendering import source

from backtests import ATTACK, Page, usual


def test_everything_is_escaped(folder: Path) -> None:
    text = (folder / "report.html").read_text(encoding="utf-8")
    page = Page(text)
    assert len(page.scripts) == 3
    assert "img" not in {tag for tag, _ in page.tags}
    assert [attributes["href"] for tag, attributes in page.tags if tag == "a"] == ["#test"]
    assert not any(name.startswith("on") for _, attributes in page.tags for name in attributes)
    assert page.text.count(ATTACK) >= 10
    assert ATTACK in page.data["weights"]["series"][0]["names"]
    assert not set("<>&'\u2028") & set(page.scripts[0])


def test_page_needs_nothing_else(folder: Path) -> None:
    page = Page((folder / "report.html").read_text(encoding="utf-8"))
    rest = re.sub(r"<script>.*?</script>", "", (folder / "report.html").read_text(), flags=re.S)
    assert "http:" not in rest
    assert "https:" not in rest
    assert "@import" not in rest
    for tag, attributes in page.tags:
        assert tag not in ("link", "iframe", "object", "embed")
        assert "src" not in attributes
    script = "".join(map(source, SCRIPTS))
    for word in ("http", "fetch", "eval(", "innerHTML", "insertAdjacentHTML", "import("):
        assert word not in script


def test_only_the_two_scripts_may_run(folder: Path) -> None:
    page = Page((folder / "report.html").read_bytes().decode())
    policies = [a["content"] for _, a in page.tags if a.get("http-equiv")]
    assert len(policies) == 1
    rules = dict(rule.strip().split(" ", 1) for rule in str(policies[0]).split(";"))
    assert rules["default-src"] == rules["connect-src"] == rules["form-action"] == "'none'"
    hashes = [base64.b64encode(hashlib.sha256(s.encode()).digest()) for s in page.scripts[1:]]
    assert rules["script-src"].split() == [f"'sha256-{value.decode()}'" for value in hashes]


def test_identifiers_are_unique_and_found() -> None:
    page = Page(render_backtest(usual(400)))  # long enough for rolling figures
    identifiers = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(identifiers) == len(set(identifiers))
    script = "".join(map(source, SCRIPTS))
    assert set(re.findall(r'byId\("([\w-]+)"\)', script)) <= set(identifiers)
    labeled = {attributes["for"] for tag, attributes in page.tags if tag == "label"}
    assert labeled == {a["id"] for tag, a in page.tags if tag in ("select", "input")}
    assert all("aria-label" in a for _, a in page.tags if a.get("role") in ("img", "region"))
