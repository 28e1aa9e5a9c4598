"""Parameters of several commands.

The options of an estimate are the fields of `pdr_graph.options.Options`, with the help below each; a command says which
of them it takes. The help of other parameters stands in the docstring of their command.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter, Token
from cyclopts.validators import Number

from pdr_graph.errors import SILENT
from pdr_graph.options import Options
from pdr_graph.whole_files import LAST, check_replaceable


def _whole(_: type, tokens: Sequence[Token]) -> int:
    return int(tokens[0].value)  # cyclopts would round 1.5


Count = Annotated[int, Parameter(converter=_whole, validator=Number(gte=0))]
PositiveCount = Annotated[int, Parameter(converter=_whole, validator=Number(gte=1))]
HYPHEN = Parameter(allow_leading_hyphen=True)  # of values such as latitudes below 0
Quiet = Annotated[bool, Parameter(("--quiet", "-q"), help="Print nothing but errors.")]
AsJson = Annotated[bool, Parameter("--json", help="Print the numbers as one JSON object, and no other text.")]
Force = Annotated[bool, Parameter(help="Write to --out even if it is a folder with other files.")]


def only(*names: str) -> Parameter:
    """Take these fields of the parameter `options` from the command line, each as an option."""
    return Parameter("*", parse=f"^(options|{'|'.join(names)})$")


def all_but(*names: str) -> Parameter:
    """Take all fields of the parameter `options` from the command line except these, each as an option."""
    return Parameter("*", parse=f"^(?!({'|'.join(names)})$)")


PersonOptions = Annotated[Options, only("walker", "height")]
PlanOptions = Annotated[Options, only("plan", "scale")]
ScaleOption = Annotated[Options, only("scale")]


@Parameter("*")
@dataclass(frozen=True)
class OutputOptions:
    """Where the files of a walk go, and what is printed."""

    out: Path | None = None
    """Output folder; default: here, named after the recording."""
    report: bool = True
    """Write report.html, or everything but it; default: write it."""
    force: Force = False
    quiet: Quiet = False
    json_: AsJson = False

    def folder(self, recording: Path, ending: str, options: Options) -> Path:
        """The output folder. Raises InputError if it has files that pdr-graph did not write, unless forced.

        ending: of its name after the recording's, without ``--out``; options: whose files may lie in it.
        """
        folder = self.out or path_named_after(recording, ending)
        check_replaceable(folder, LAST, self.force, [recording, *options.files])
        return folder


def path_named_after(recording: Path, ending: str) -> Path:
    """A path in the current folder, named after a recording: walk-smoothed for walk.zip."""
    path = recording.resolve()
    return Path(f"{path.name if path.is_dir() else path.stem}{ending}")


@contextmanager
def applied(given: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Set numbers by ``--set`` and print nothing by ``--quiet`` or ``--json`` within a ``with`` block.

    given: the parameters of a command; yields them with the numbers that were set in `Options.settings`. Raises
    InputError for a number that there is not.
    """
    values, parameters = dict[str, Any](), dict(given)
    for value in given.values():
        values |= vars(value) if is_dataclass(value) else {}
    values |= given
    with ExitStack() as stack:
        if values.get("settings"):
            from pdr_graph.walk import settings_changed

            kept = stack.enter_context(settings_changed(values["settings"]))
            parameters["options"] = replace(given["options"], settings=tuple(kept))
        if values.get("quiet") or values.get("json_"):
            token = SILENT.set(True)
            stack.callback(SILENT.reset, token)
        yield parameters
