"""The page that a participant of a study gets in the app: one walk in Markdown, from its summary."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from pdr_graph.errors import count, one_line
from pdr_graph.types import DOUBTFUL, OK

MOST_LISTED = 8  # of each list: the report is one page
SPECIAL = re.compile(r"([\\`*_{}\[\]<>#|~])")
VERDICT_WORDS = {
    OK: "The sources of this walk agree with each other.",
    DOUBTFUL: "**Treat the path with caution**: sources of this walk contradict each other.",
}
NOT_CONSISTENT = "**The path cannot be trusted**: nothing fits together."


def report(summary: Mapping[str, Any]) -> str:
    """The report of a walk by its ``summary.json``."""
    verdict = summary["verdict"]
    lines = ["# Your walk", "", VERDICT_WORDS.get(verdict["state"], NOT_CONSISTENT), ""]
    lines += ["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in _figures(summary)), ""]
    lines += _listed("What contradicts", [f"{each['text']} Check: {each['check']}" for each in verdict["reasons"]])
    lines += _listed("What could not be estimated", summary["missing"])
    lines += _listed("Notes on the recording", summary["warnings"])
    lines.append(f"*pdr\\_graph {plain(summary['versions']['pdr_graph'])}*")
    return "\n".join(lines) + "\n"


def refusal(reason: str) -> str:
    """The report of a recording that cannot be used."""
    return f"# Your walk\n\nThis recording could not be reconstructed.\n\n{plain(reason)}\n"


def plain(text: str) -> str:
    """Untrusted text on one line, without meaning in Markdown."""
    return SPECIAL.sub(r"\\\1", one_line(text))


def _figures(summary: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    minutes, seconds = divmod(round(summary["duration"]), 60)
    yield "duration", f"{minutes} min {seconds} s"
    yield "steps", f"{summary['steps']}"
    yield "distance", f"{summary['distance']:.0f} m"
    if summary["steps"]:
        yield "mean step", f"{summary['distance'] / summary['steps']:.2f} m"
    if len(summary["floors"]) > 1:
        yield "floors", plain(" → ".join(summary["floors"]))
    yield "positions used", f"{sum(fix['weight'] > 0 for fix in summary['fixes'])} of {len(summary['fixes'])}"
    protection = summary.get("protection")
    if protection:
        worst = max(protection["along_95"]["worst"], protection["across_95"]["worst"])
        median = max(protection["along_95"]["median"], protection["across_95"]["median"])
        yield "error with 95 % probability below", f"{median:.1f} m on most of the way, {worst:.1f} m at worst"
    else:
        yield "position", "not known: there is the shape of the walk alone"


def _listed(title: str, lines: list[str]) -> list[str]:
    if not lines:
        return []
    more = len(lines) - MOST_LISTED
    listed = [f"- {plain(line)}" for line in lines[:MOST_LISTED]]
    return [f"## {title}", "", *listed, *([f"- and {count(more, 'line')} more"] if more > 0 else []), ""]
