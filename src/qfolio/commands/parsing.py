"""Commands as tyro parses them: grouped options and ``--json``, from signatures and docstrings."""

import contextlib
import dataclasses
import functools
import inspect
import io
import json
import re
import shutil
import sys
import textwrap
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import docstring_parser
import tyro
from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, arg, configure

from qfolio.core.errors import QfolioError
from qfolio.core.text import finite, near
from qfolio.experiments.lasting import lasting

PAGE = "report.html"

Document = dict[str, Any]
"""What a command reports: JSON values, paths, and numbers that may be infinite or missing."""

GROUPS = {
    "price": "prices missing late ended delisting_haircut members features columns returns date",
    "account": "holdings capital whole_shares as_of",
    "split": "train test rolling lag lags",
    "cost and mandate": "cost_bps costs_bps cost_model cap mandate limits calendar",
    "learning": "agents agent preset signals seeds seed episodes steps assignments batch search "
    "change rate renewal epsilon",
    "comparison": "baselines strategy benchmark trials after",
    "run": "anyway update reproduce resume join on track trust",
    "output": "out title compare live port open pdf orders layout currency dry_run as_json",
}
"""The options of each group in ``--help``."""

_GROUP_OF = {option: group for group, options in GROUPS.items() for option in options.split()}


class Failed(SystemExit):
    """Ends a command with code 2 after it has reported what is wrong."""

    def __init__(self, document: Document) -> None:
        super().__init__(2)
        self.document = document


class Option(NamedTuple):
    """An option, or a positional argument, as tyro reads it."""

    name: str
    hint: Any
    default: Any


def grouped(command: Callable[..., Any]) -> Callable[..., None]:
    """The command with its options in groups, and with ``--json`` if it returns a Document.

    Options of a dataclass become options of the command.
    """
    hints = typing.get_type_hints(command, include_extras=True)
    meanings = _meanings(command)
    kinds: dict[str, type] = {}  # the dataclasses of the command, by their parameters
    parameters: list[inspect.Parameter] = []
    groups: dict[str, list[Option]] = {}
    loose: list[Option] = []
    for parameter in inspect.signature(command).parameters.values():
        name, hint = parameter.name, hints[parameter.name]
        kind = typing.get_args(hint)[0] if typing.get_origin(hint) is Annotated else hint
        if dataclasses.is_dataclass(kind):
            kinds[name] = typing.cast(type, kind)
            loose += _options(kinds[name])
            continue
        option = _option(name, hint, parameter.default, meanings.get(name, ""))
        if parameter.kind is parameter.KEYWORD_ONLY:
            loose.append(option)
        else:
            parameters.append(parameter.replace(annotation=option.hint))
    if hints["return"] is not type(None):
        meaning = "Print one JSON document; everything else goes to standard error."
        loose.append(_option("as_json", Annotated[bool, arg(name="json")], False, meaning))
    for option in loose:
        groups.setdefault(_GROUP_OF.get(option.name, ""), []).append(option)
    keyword = inspect.Parameter.KEYWORD_ONLY
    for option in groups.pop("", []):
        parameters.append(
            inspect.Parameter(option.name, keyword, annotation=option.hint, default=option.default)
        )
    bundles = [group for group in GROUPS if group in groups]
    for group in bundles:
        bundle = _bundle(groups[group])
        named = Annotated[bundle, arg(name=group)]  # type: ignore[valid-type]
        parameters.append(
            inspect.Parameter(_parameter(group), keyword, annotation=named, default=bundle())
        )

    def run(given: dict[str, Any]) -> None:
        for group in bundles:
            given |= vars(given.pop(_parameter(group)))
        as_json = given.pop("as_json", False)
        for name, kind in kinds.items():
            own = [field.name for field in dataclasses.fields(kind)]
            given[name] = kind(**{option: given.pop(option) for option in own})
        _report(command, given, as_json)

    call: Any = configure(OmitArgPrefixes)(lambda **given: run(given))
    call.__name__, call.__doc__ = command.__name__, command.__doc__
    call.__module__ = command.__module__
    call.__signature__ = inspect.Signature(parameters)
    call.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return typing.cast(Callable[..., None], call)


def chosen(command: Callable[..., Any], name: str, words: list[str]) -> Callable[[], Any]:
    """The command bound to the options in ``words``, ready to run.

    Raises QfolioError where tyro would print an error box.
    """

    @functools.wraps(command)
    def bound(*args: Any, **options: Any) -> Callable[[], Any]:
        return functools.partial(command, *args, **options)

    program, shown = f"qfolio {name}", io.StringIO()
    try:
        with contextlib.redirect_stderr(shown):
            return tyro.cli(bound, prog=program, description=description(command), args=words)
    except SystemExit as error:
        if error.code in (None, 0):  # --help
            raise
    raise QfolioError(f"{refusal(shown.getvalue())} See {program} --help.")


def refusal(box: str) -> str:
    """The error in tyro's box, as one sentence."""
    plain = re.sub(r"\x1b\[[\d;]*m", "", box)  # tyro colors what it shows in a terminal
    text = " ".join(re.sub("[╭╮╰╯│]", " ", plain).split())
    parts = [part.strip() for part in re.split("─+|-{3,}", text) if part.strip()]
    said = parts[min(1, len(parts) - 1)]  # after the title
    if found := re.match(r"Unrecognized options?: ([^\s,]+)", said):
        meant = re.search(r"Perhaps you meant:[\s─-]*(--[\w-]+)", text)
        unknown = "option" if found[1].startswith("-") else "argument"
        return f"there is no {unknown} {found[1]}{f'; did you mean {meant[1]}?' if meant else '.'}"
    if found := re.match(r"Missing from .*?: (\S+)\s+(.*?)\.? \(required\)", said):
        return f"{found[1]} is missing: {found[2][:1].lower()}{found[2][1:]}."
    if found := re.match(r"Missing value for argument '([^']+)'", said):
        return f"{found[1]} needs a value."
    if found := re.match(r"invalid choice '(.*)' for argument '([^']+)'\. .*\((.*)\)", said):
        known = [choice.strip(" '") for choice in found[3].split(",")]
        if "None" in known:  # an option that may be left out; tyro lists such choices in any order
            known = sorted({*known} - {"None"})
        return f"{found[2]} is {found[1]!r}; {near(found[1], known)}"
    found = re.match(r"Error parsing (\S+): ", said)
    values = re.findall(r"'([^']*)'", said)
    if found and values and (kind := re.search(r"\b(int|float)\b", said)):
        number = "a whole number" if kind[1] == "int" else "a number"
        return f"{found[1]} is {values[-1]!r}; it must be {number}."
    return f"{said.rstrip('.')}."


def summary(command: Callable[..., Any]) -> str:
    """The first sentence of a command's docstring."""
    return docstring_parser.parse(command.__doc__ or "").short_description or ""


def description(command: Callable[..., Any]) -> str:
    """What a command does, and its examples, as its ``--help`` shows them."""
    parsed = docstring_parser.parse(command.__doc__ or "")
    width = shutil.get_terminal_size().columns
    said = " ".join(filter(None, (parsed.short_description, parsed.long_description)))
    indent = "  "  # without it, tyro would join the lines
    parts = [textwrap.fill(said, width, initial_indent=indent, subsequent_indent=indent)]
    if examples := [line.strip() for line in example(command)]:
        parts.append("\n".join(["Examples:", *(f"  {line}" for line in examples)]))
    return "\n\n".join(parts)


def example(command: Callable[..., Any]) -> list[str]:
    """The command lines in the section "Examples" of a command's docstring."""
    parsed = docstring_parser.parse(command.__doc__ or "")
    return [line for found in parsed.examples for line in (found.description or "").splitlines()]


def outcome(folder: Path, content: Document) -> Document:
    """Says where a command has written its report, and returns the command's document."""
    from qfolio.commands.console import say

    say(f"Report: {folder / PAGE}")
    return {"folder": folder, "report": folder / PAGE, **content}


def _report(command: Callable[..., Any], given: dict[str, Any], as_json: bool) -> None:
    """Runs a command; with ``as_json``, prints only its document to the standard output."""
    command = lasting()(command)
    if not as_json:
        command(**given)
        return
    failed = None
    with contextlib.redirect_stdout(sys.stderr):
        try:
            document = command(**given)
        except Failed as failure:
            failed, document = failure, failure.document
    print(json.dumps(finite(document), indent=2, allow_nan=False, default=str))
    if failed is not None:
        raise failed


def _meanings(part: Any) -> dict[str, str]:
    """The description of each parameter in a function's or a class's docstring."""
    parsed = docstring_parser.parse(part.__doc__ or "")
    return {found.arg_name: " ".join((found.description or "").split()) for found in parsed.params}


def _options(kind: type) -> list[Option]:
    hints = typing.get_type_hints(kind, include_extras=True)
    meanings: dict[str, str] = {}
    for parent in reversed(kind.__mro__):
        meanings |= _meanings(parent)
    return [
        _option(field.name, hints[field.name], field.default, meanings.get(field.name, ""))
        for field in dataclasses.fields(kind)
    ]


def _option(name: str, hint: Any, default: Any, meaning: str) -> Option:
    """An option whose help names its default, unless it is a switch that is off."""
    markers: list[Any] = [FlagCreatePairsOff] if default is False else []
    if not (default is False or default is inspect.Parameter.empty or "(default:" in meaning):
        meaning = f"{meaning.removesuffix('.')} (default: {_shown(default)})."
    helped = arg(help=meaning, help_behavior_hint="")
    return Option(name, Annotated[(hint, helped, *markers)], default)


def _shown(default: Any) -> str:
    if default is True:
        return "yes"
    if isinstance(default, float):
        return f"{default:g}"
    return "none" if default in (None, "", ()) else str(default)


def _bundle(options: list[Option]) -> type:
    """A dataclass with these options; tyro shows it as a group."""
    made = dataclasses.make_dataclass("Options", options, frozen=True)
    made.__doc__ = " "  # tyro would print the generated one
    return made


def _parameter(group: str) -> str:
    return group.replace(" ", "_") + "_options"
