"""Text on the terminal: names of files, plans and persons come from others, and a terminal obeys control characters."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperCommand

from pdr_graph.errors import EXIT_DEGRADED, SILENT, first_look, printable


def echo(text: str, err: bool = False) -> None:
    """Print one line, with � for each character that is not printable; nothing if silent, except errors.

    err: on standard error.
    """
    if err or not SILENT.get():
        typer.echo(printable(text), err=err)


def echo_errors(*lines: object) -> None:
    """Print each line on standard error, after the program's name."""
    for line in lines:
        echo(f"pdr-graph: {line}", err=True)


def echo_lines(text: str) -> None:
    """Print a text of several lines, each as by `echo`."""
    if not SILENT.get():
        echo_result(text)


def echo_result(text: str) -> None:
    """Print lines that a program reads, even if silent: what ``--json`` asks for."""
    for line in text.removesuffix("\n").split("\n"):
        typer.echo(printable(line))


TYPE = re.compile(r" <[^<>]*>$")  # after the name of an argument
BRACES = re.compile(r"^\{(.*?)\}(?:\.\.\.)?$")  # around the name of a required argument


class PlainCommand(TyperCommand):
    """A command whose help names its arguments as its metavars do: RECORDING, not {RECORDING} or RECORDING <path>."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """The arguments of the usage line."""
        return [BRACES.sub(r"\1", piece) for piece in super().collect_usage_pieces(ctx)]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the sections of arguments and options."""
        write = formatter.write_dl

        def plain(rows: Any, *args: Any, **more: Any) -> None:
            write([(name if name.startswith("-") else TYPE.sub("", name), text) for name, text in rows], *args, **more)

        formatter.write_dl = plain
        super().format_options(ctx, formatter)


class App(typer.Typer):
    """A group of commands with plain help."""

    def command(self, name: str | None = None, **more: Any) -> Callable[[Any], Any]:
        """Register a command, as `typer.Typer.command` does."""
        return super().command(name, cls=PlainCommand, **more)


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
        raise typer.Exit(EXIT_DEGRADED)


def lines_of(summary: Mapping[str, Any]) -> Iterator[str]:
    """Yield the verdict with the key figures, the errors if a truth is known, the reasons and the warnings.

    The first line begins with "ok:" if and only if the exit code is 0.
    """
    steps, state = f"{summary['steps']} steps, " if summary["steps"] else "", summary["verdict"]["state"]
    sigma = "no absolute position" if summary["sigma"] is None else f"median sigma {summary['sigma']:.2f} m per axis"
    begin = f"{state}, incomplete" if state == "ok" and summary["missing"] else state
    yield f"{begin}: {steps}{summary['distance']:.1f} m in {summary['duration']:.1f} s, {sigma}"
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
