"""Help without the types and braces that typer writes around the names of arguments."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import typer
from typer.core import TyperCommand

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
