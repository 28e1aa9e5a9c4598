"""A Markdown extension: the equations that arithmatex finds become MathML, which browsers draw without any script."""

from xml.etree.ElementTree import Element

from latex2mathml.converter import convert_to_element
from markdown import Extension, Markdown
from markdown.treeprocessors import Treeprocessor

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
