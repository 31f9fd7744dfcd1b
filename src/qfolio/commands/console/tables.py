"""What is printed about price tables: their content, and findings on them."""

from typing import TYPE_CHECKING, Any

from qfolio.commands.console import say, tell
from qfolio.core.text import amount, printable

if TYPE_CHECKING:
    from qfolio.portfolio.prices.findings import Finding


def print_findings(findings: "list[Finding]") -> None:
    """The findings on a price table, errors first, then warnings and notes."""
    severities = ("error", "warning", "note")
    for finding in sorted(findings, key=lambda finding: severities.index(finding.severity)):
        tell(f"{finding.severity}: {finding}. {finding.advice}".rstrip())
    if findings:
        counts = (sum(f.count for f in findings if f.severity == kind) for kind in severities)
        said = (amount(n, kind) for n, kind in zip(counts, severities, strict=True))
        say(f"{', '.join(said)}.")


def print_warnings(file: str, findings: "list[Finding]") -> None:
    """The warnings on a price table, each with the name of its file."""
    for finding in findings:
        if finding.severity == "warning":
            tell(f"Warning: {file}, {finding}. {finding.advice}".rstrip())


def print_prices(facts: dict[str, Any]) -> None:
    """The content of a price table, from ``prices.describe``."""
    say(
        f"{printable(facts['source'])}: {amount(facts['rows'], 'row')} of "
        f"{amount(facts['assets'], 'asset')}, "
        f"{facts['first']} to {facts['last']}, about {facts['periods_per_year']:g} a year."
    )
    if facts["features"]:
        say(f"Features: {printable(', '.join(facts['features']))}.")
    if facts["columns"]:
        say(f"Columns of the market: {printable(', '.join(facts['columns']))}.")
    if facts["note"]:
        say(f"Note: {facts['note']}")
