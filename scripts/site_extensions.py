"""For scripts/docs: equations become MathML, and docstrings' ``name: what it is; other: …`` becomes a list."""

import re
from xml.etree.ElementTree import Element

from griffe import Class, Function, Module
from griffe import Extension as GriffeExtension
from latex2mathml.converter import convert_to_element
from markdown import Extension, Markdown
from markdown.treeprocessors import Treeprocessor

NAMED = re.compile(r"(?:^|(?<=[;.:)] ))(\w+(?:, \w+)*): ")


class Fields(GriffeExtension):
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


# Equations

BEFORE_TEXT_IS_RESTORED = 15  # after arithmatex (inline patterns, 20), before prettify (10)
BRACKETS = slice(2, -2)  # \( … \) or \[ … \], as arithmatex's generic form has it


class Equations(Treeprocessor):
    """Every element of class arithmatex: its TeX replaced by MathML."""

    def run(self, root: Element) -> None:
        for found in list(root.iter()):
            if found.get("class") == "arithmatex":
                display = "block" if found.tag == "div" else "inline"
                tex, found.text = (found.text or "").strip()[BRACKETS], None
                found.append(convert_to_element(tex, display=display))


class MathML(Extension):
    def extendMarkdown(self, md: Markdown) -> None:
        md.treeprocessors.register(Equations(md), "mathml", BEFORE_TEXT_IS_RESTORED)


def makeExtension(**options) -> MathML:
    return MathML(**options)
