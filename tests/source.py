"""The source of the package: every file once read and parsed."""

import ast
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "pdr_graph"
FILES = sorted(PACKAGE.rglob("*.py"))


@cache
def text_of(path):
    return path.read_text(encoding="utf-8")


@cache
def tree_of(path):
    return ast.parse(text_of(path))


def name_of(path):
    """The path of a file within the package."""
    return path.relative_to(PACKAGE).as_posix()
