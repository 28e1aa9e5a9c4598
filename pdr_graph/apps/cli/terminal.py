"""Text on the terminal: names of files, plans and persons come from others, and a terminal obeys control characters."""

from __future__ import annotations

import typer

from pdr_graph.errors import SILENT, printable


def echo(text: str, err: bool = False) -> None:
    """Print one line, with � for each character that is not printable; nothing if silent, except errors.

    err: on standard error.
    """
    if err or not SILENT.get():
        typer.echo(printable(text), err=err)


def echo_lines(text: str) -> None:
    """Print a text of several lines, each as by `echo`."""
    if not SILENT.get():
        echo_result(text)


def echo_result(text: str) -> None:
    """Print lines that a program reads, even if silent: what ``--json`` asks for."""
    for line in text.removesuffix("\n").split("\n"):
        typer.echo(printable(line))
