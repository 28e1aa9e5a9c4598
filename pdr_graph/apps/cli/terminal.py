"""Text on the terminal: names of files, plans and persons come from others, and a terminal obeys control characters."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from textwrap import fill, indent
from typing import Any, get_args

from cyclopts.exceptions import (
    CoercionError,
    CycloptsError,
    MissingArgumentError,
    UnknownOptionError,
    UnusedCliTokensError,
    ValidationError,
)

from pdr_graph.errors import EXIT_DEGRADED, SILENT, InputError, first_look, printable

WIDEST = 100  # [characters] a line of help
LONGEST_NAME = 30  # [characters] an option with its value beside its help
VALUES = {"FLOAT": "NUMBER", "INT": "NUMBER", "STR": "TEXT", "STR...": "TEXT"}  # of types of Python, in help
UNSAID = ("True", "False", "()", '""')  # defaults that the help of an option does not repeat


def echo(text: str, err: bool = False) -> None:
    """Print one line, with � for each character that is not printable; nothing if silent, except errors.

    err: on standard error.
    """
    if err or not SILENT.get():
        print(printable(text), file=sys.stderr if err else sys.stdout, flush=True)


def echo_errors(*lines: object) -> None:
    """Print each line on standard error, after the program's name."""
    for line in lines:
        echo(f"pdr-graph: {line}", err=True)


def echo_progress(text: str, end: str = "") -> None:
    """Replace the line of progress on standard error by `text`."""
    print(f"\r{printable(text)}", end=end, file=sys.stderr, flush=True)


def echo_lines(text: str) -> None:
    """Print a text of several lines, each as by `echo`."""
    if not SILENT.get():
        echo_result(text)


def echo_result(text: str) -> None:
    """Print lines that a program reads, even if silent: what ``--json`` asks for."""
    for line in text.removesuffix("\n").split("\n"):
        print(printable(line), flush=True)


SYNONYMS = {  # what others call our options
    **dict.fromkeys(("--plan", "--floorplan", "--floor-plan"), "--map"),
    **dict.fromkeys(("--gps", "--gnss", "--positions"), "--fixes"),
    **dict.fromkeys(("--output", "--outdir", "-o"), "--out"),
    "--ble": "--beacons",
}


def usage_error(error: CycloptsError) -> InputError | str:
    """What is wrong with a command line: the argument or option, its value, and what is expected."""
    if isinstance(error, UnusedCliTokensError) and error.unused_tokens:
        return InputError(error.unused_tokens[0], "", "an argument too many", "options, or nothing")
    if isinstance(error, UnknownOptionError) and error.token.keyword in SYNONYMS:
        return InputError(error.token.keyword, "", "no such option", SYNONYMS[error.token.keyword])
    argument = error.argument
    if isinstance(error, MissingArgumentError) and argument:
        expected = f"one (pdr-graph {' '.join([*(error.command_chain or ()), '--help'])})"
        return InputError(error.keyword or argument.name, "", "no value", expected)
    if isinstance(error, CoercionError | ValidationError) and argument and argument.tokens:
        token, kinds = argument.tokens[-1], get_args(argument.hint) or (argument.hint,)
        choices = "one of " + (", ".join(kind for kind in kinds if isinstance(kind, str)) or "true, false")
        expected = "a whole number" if int in kinds else "a number" if float in kinds else choices
        if isinstance(error, ValidationError):
            expected = error.exception_message.removeprefix("Must be ").removesuffix(".")
        return InputError(token.keyword or argument.name, "", token.value, expected)
    return str(error)


class PlainHelp:
    """Help as plain text, with each option in two columns; a formatter of cyclopts."""

    def render_usage(self, console: Any, options: Any, usage: Any) -> None:
        """Print the line of the usage."""
        print(f"Usage: {usage}", file=console.file)

    def render_description(self, console: Any, options: Any, description: Any) -> None:
        """Print the paragraphs of a docstring, examples with their lines as they are."""
        for paragraph in _plain(description).split("\n\n"):
            example = paragraph.startswith("pdr-graph ")
            print(indent(paragraph, "  ") if example else _filled(paragraph, console, "  ", "  "), file=console.file)
            print(file=console.file)

    def __call__(self, console: Any, options: Any, panel: Any) -> None:
        """Print a section of arguments, options or commands."""
        rows = [(_name(entry), _help(entry)) for entry in panel.entries]
        if not rows:
            return
        column = 4 + max(len(name) for name, _ in rows if len(name) <= LONGEST_NAME or len(rows) == 1)
        print(f"{str(panel.title).replace('Parameters', 'Options')}:", file=console.file)
        for name, text in rows:
            first = f"  {name}".ljust(column)
            if len(first) > column:
                print(first, file=console.file)
                first = " " * column
            print(_filled(text, console, first, " " * column), file=console.file)
        print(file=console.file)


def _name(entry: Any) -> str:
    """An argument, an option with its value, or a command, in help."""
    if entry.positional_label:
        return entry.positional_label
    name = ", ".join((*entry.positive_shorts, *entry.positive_names))
    if entry.default == "True":
        return " / ".join((name, *entry.negative_names))
    value = "|".join(entry.choices) if entry.choices else VALUES.get(entry.metavar, entry.metavar)
    return f"{name} {value}" if value else name


def _help(entry: Any) -> str:
    """The help of an argument or option, with its default if it has one."""
    default = "" if entry.default is None or entry.default in UNSAID else f" [default: {entry.default}]"
    return _plain(entry.description) + default + " [required]" * entry.required


def _plain(text: Any) -> str:
    return str(getattr(text, "primary_renderable", text) or "")


def _filled(text: str, console: Any, first: str, others: str) -> str:
    width = min(console.width, WIDEST)
    return fill(" ".join(text.split()), width, initial_indent=first, subsequent_indent=others, break_on_hyphens=False)


def print_summary(out: Path, missing: tuple[str, ...], as_json: bool = False) -> None:
    """Print the results in a folder as text, or its summary as JSON; exit with EXIT_DEGRADED unless all is well.

    missing: what could not be estimated or written.
    """
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    if as_json:
        echo_result(json.dumps(summary, indent=2))  # names of any bytes as escapes, so that they stay exact
    for line in lines_of(summary):
        echo(line)
    echo(f"-> {first_look(out)}")
    if missing:
        echo_errors(f"finished without {'; '.join(missing)} (see {out / 'summary.json'})")
    if missing or summary["verdict"]["state"] != "ok":
        sys.exit(EXIT_DEGRADED)


def lines_of(summary: Mapping[str, Any]) -> Iterator[str]:
    """Yield the verdict with the key figures, the errors if a truth is known, the reasons and the warnings.

    The first line begins with "ok:" if and only if the exit code is 0.
    """
    steps, state = f"{summary['steps']} steps, " if summary["steps"] else "", summary["verdict"]["state"]
    sigma = "no absolute position" if summary["sigma"] is None else f"median sigma {summary['sigma']:.2f} m per axis"
    off = "" if summary["sigma"] or summary.get("distance_sigma") is None else f" ± {summary['distance_sigma']:.0f}"
    begin = f"{state}, incomplete" if state == "ok" and summary["missing"] else state
    yield f"{begin}: {steps}{summary['distance']:.1f}{off} m in {summary['duration']:.1f} s, {sigma}"
    yield from live_lines(summary.get("live"))
    if "live" not in summary:
        yield from score_lines(summary["scores"])
    if summary["frame"]["kind"] == "enu":
        yield "metres east and north of {origin_lat:.6f}, {origin_lon:.6f}".format(**summary["frame"])
    for reason in summary["verdict"]["reasons"]:
        yield f"{state}: {reason['text']} (to check: {reason['check']})"
    for warning in summary["warnings"]:
        yield f"note: {warning}"


def live_lines(live: Mapping[str, Any] | None) -> Iterator[str]:
    """Yield ``live`` of ``summary.json`` as text; without truth the sigma of the current poses."""
    if live is None:
        return
    from pdr_graph.apps.report.evaluation import error_text
    from pdr_graph.apps.report.output_files import KNOWN_AT_ONCE

    error, smoothed = live["error"], live["hindsight"]["error"]
    first = f"first pose after {live['first_pose']:.1f} s"
    if error is None:
        yield f"{KNOWN_AT_ONCE}: {first}, median sigma {live['sigma']:.1f} m"
        return
    yield f"{KNOWN_AT_ONCE}: error 50 / 75 / 95 %: {error_text(error)}; {first}"
    if smoothed is not None:
        yield f"in hindsight, smoothed: error 50 / 75 / 95 %: {error_text(smoothed)}"


def score_lines(scores: Mapping[str, Any] | None) -> Iterator[str]:
    """Yield ``scores`` of ``summary.json`` as text; nothing without truth."""
    if scores is not None and scores["ce"] is not None:
        from pdr_graph.apps.report.evaluation import error_text

        errors = error_text({**scores["ce"], "in_90": scores["in_90"]})
        yield f"against the truth: error 50 / 75 / 95 %: {errors}"
