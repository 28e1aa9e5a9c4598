"""A Griffe extension: what our docstrings say as ``name: what it is; other: …`` becomes a list on the API pages."""

import re

from griffe import Class, Extension, Function, Module

NAMED = re.compile(r"(?:^|(?<=[;.:)] ))(\w+(?:, \w+)*): ")


class Fields(Extension):
    def on_package(self, *, pkg: Module, **_) -> None:
        mend(pkg)


def mend(of: Module | Class | Function) -> None:
    """Its docstring and those of what is in it, which may name their parameters and attributes."""
    if of.docstring is not None:
        of.docstring.value = listed(of.docstring.value, names_of(of))
    for member in of.members.values():
        if isinstance(member, (Module, Class, Function)):
            mend(member)


def names_of(of: Module | Class | Function) -> set[str]:
    if isinstance(of, Function):
        return {parameter.name for parameter in of.parameters}
    made = of.members.get("__init__")
    return set(of.members) | (names_of(made) if isinstance(made, Function) else set())


def listed(text: str, names: set[str]) -> str:
    """Markdown in which the first of the names that a paragraph tells of begins a list."""
    return "\n\n".join(_listed(paragraph, names) for paragraph in text.split("\n\n"))


def _listed(paragraph: str, names: set[str]) -> str:
    line = " ".join(paragraph.split())
    found = [m for m in NAMED.finditer(line) if names.issuperset(m[1].split(", "))]
    if not found:
        return paragraph
    ends = [m.start() for m in found[1:]] + [len(line)]
    items = "\n".join(f"* **{m[1]}**: {line[m.end() : end].rstrip('; ')}" for m, end in zip(found, ends, strict=True))
    led_by = line[: found[0].start()].rstrip()
    return f"{led_by}\n\n{items}" if led_by else items
