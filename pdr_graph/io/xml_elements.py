"""Elements of XML files as apps write them, damaged ones too, in bounded memory.

Every element of one kind (a track point, a placemark) is parsed by itself, so that damage elsewhere costs nothing: a
prefix that is not declared, a blank first line, control characters, a bare ``&``, an end in the middle. Of a damaged
element, what can be read is kept. Files are untrusted: document types, entities and the network are refused.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterator
from contextlib import suppress
from typing import Protocol

from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] no stubs

from pdr_graph.errors import InputError, count

LONGEST_ELEMENT = 50_000_000  # characters from one element to the next, whose tree takes 1 GB of memory
PIECE = 1 << 20  # [bytes] read at a time
KEPT = 4000  # characters of the head, and before an element: a document type or the root's end may be cut in two
# Encodings in XML declarations that are believed; other texts are UTF-8
ENCODING = re.compile(rb"encoding\s*=\s*.((?i:iso-8859|windows-125|koi8|gb|big5|shift_jis|euc)[\w.-]*)")
CONTROL = re.compile("[\0-\x08\x0b\x0c\x0e-\x1f\ufffe\uffff]")
# Prefixes of elements and of attributes; sre finds a pattern that begins with a fixed character five times as fast
OPENING, CLOSING = re.compile(r"<([A-Za-z_][\w.-]*):(?=[A-Za-z_])"), re.compile(r"</[A-Za-z_][\w.-]*:(?=[A-Za-z_])")
ATTRIBUTE = re.compile(r" (?!xml(?:ns)?:)[A-Za-z_][\w.-]*:(?=[\w.-]+\s*=\s*[\"'])")
DECLARATION = re.compile(r"xmlns:([\w.-]+)\s*=")
BARE_AND = re.compile(r"&(?!(?:amp|lt|gt|quot|apos|#\d+|#x[\da-fA-F]+);)")
COMMENT = re.compile(r"<!--.*?(?:-->|\Z)", re.DOTALL)
CLOSED = re.compile(r".*</[^<>]*>", re.DOTALL)  # up to the last end of an element
SAFE = {"resolve_entities": False, "no_network": True, "load_dtd": False, "huge_tree": False}
STRICT, RECOVERING = (etree.XMLParser(recover=recover, remove_pis=True, **SAFE) for recover in (False, True))


class Readable(Protocol):
    """Whatever has bytes to read."""

    def read(self, size: int, /) -> bytes:
        """The next bytes, at most `size`."""
        ...


class XmlElements:
    """The elements of one kind in an XML file, by iteration. Their names have no prefix.

    head: the begin of the file; is_cut: True if it ends in the middle, after the last element.
    """

    def __init__(self, stream: Readable, where: str, root: str, tag: str):
        """where: name of the file in messages; root, tag: names of the root and of the elements."""
        self._stream, self._where, self._root, self._tag = stream, where, root, tag
        self._start, self._end = re.compile(rf"<{tag}(?=[\s/>])"), re.compile(rf"</{tag}\s*>")
        self._prefixes, self._declared, self._controls = set[str](), set[str](), 0
        self._line, self._first = 1, 0  # of the text in hand, and of the first damaged element
        self._damaged = 0
        self.head, self.is_cut = "", False

    def __iter__(self) -> Iterator[etree._Element]:
        """Each element. Raises InputError for a document type definition, or where an element is too long."""
        text = ""
        for piece in self._pieces():
            text += piece
            self.head = self.head or text[:KEPT]
            if "<!DOCTYPE" in text:
                raise InputError(self._where, "", "a document type definition", "plain XML without one")
            if text.rfind("<!--") <= text.rfind("-->"):
                text = _without_comments(text)
                starts = [match.start() for match in self._start.finditer(text)]
                cut = starts[-1] if starts else max(0, len(text) - KEPT)
                yield from self._elements(text[:cut])
                text = text[cut:]
            if len(text) > LONGEST_ELEMENT:
                found = f"an element of more than {LONGEST_ELEMENT // 10**6} MB"
                raise InputError(self._where, "", found, "shorter tracks")
        text = _without_comments(text)
        self.is_cut = not re.search(rf"</{self._root}\s*>|<{self._root}\b[^<>]*/>", text)
        yield from self._elements(text)

    @property
    def notes(self) -> list[str]:
        """What was mended and what is damaged, a text each; complete after the last element."""
        undeclared = ", ".join(sorted(self._prefixes - self._declared))[:60]
        return [
            *(["blank lines before the XML declaration"] if re.match(r"\s+<\?xml", self.head) else []),
            *([f"prefix {undeclared} without a declaration"] if undeclared else []),
            *([f"{count(self._controls, 'control character')} left out"] if self._controls else []),
            *([f"{self._damaged} damaged <{self._tag}>, the first in line {self._first}"] if self._damaged else []),
        ]

    def _pieces(self) -> Iterator[str]:
        """The text, mended; each piece ends before a tag."""
        content = self._stream.read(PIECE)
        stated = ENCODING.search(content[:200])
        encoding = "utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else stated[1].decode() if stated else "utf-8"
        try:
            decoder = codecs.getincrementaldecoder(encoding)("replace")
        except LookupError:
            decoder = codecs.getincrementaldecoder("utf-8")("replace")
        rest = ""
        while content:
            text, controls = CONTROL.subn("", rest + decoder.decode(content))
            self._controls += controls
            text, tag, rest = text.rpartition("<")
            rest = tag + rest
            yield self._mended(text)
            content = self._stream.read(PIECE)
        yield self._mended(rest + decoder.decode(b"", True))

    def _mended(self, text: str) -> str:
        """`text` without prefixes, and with each bare ``&`` escaped."""
        self._declared.update(DECLARATION.findall(text))
        self._prefixes.update(OPENING.findall(text))
        text = ATTRIBUTE.sub(" ", CLOSING.sub("</", OPENING.sub("<", text)))
        return BARE_AND.sub("&amp;", text) if "&" in text else text

    def _elements(self, text: str) -> Iterator[etree._Element]:
        """The elements that begin in a text. They are parsed together, only if that fails each by itself."""
        starts = [match.start() for match in self._start.finditer(text)]
        parts = [self._part(text[a:b]) for a, b in zip(starts, [*starts, len(text)][1:], strict=True)]
        found: list[etree._Element | None] = [None] * len(parts)
        if all(is_whole for _, is_whole in parts):
            with suppress(etree.XMLSyntaxError, ValueError):
                found = list(etree.fromstring(f"<x>{''.join(part for part, _ in parts)}</x>", STRICT))
        for start, part, element in zip(starts, parts, found, strict=True):
            if element is None:
                before, element = self._damaged, self._alone(*part)
                self._first = self._first or (self._damaged > before and self._line + text.count("\n", 0, start))
            if element is not None:
                yield element
        self._line += text.count("\n")

    def _part(self, text: str) -> tuple[str, bool]:
        """The element at the begin of a text, and whether it has its end."""
        opened = text.find(">")
        if text[opened - 1 : opened] == "/":
            return text[: opened + 1], True
        end = self._end.search(text)
        return (text[: end.end()], True) if end else (text, False)

    def _alone(self, text: str, is_whole: bool) -> etree._Element | None:
        """One element; of a damaged one, its parts that are whole. None if it has none."""
        if is_whole:
            with suppress(etree.XMLSyntaxError, ValueError):
                return etree.fromstring(text, STRICT)
        self._damaged += not self.is_cut  # where the file ends, that is what is wrong
        closed = CLOSED.match(text)
        with suppress(etree.XMLSyntaxError, ValueError):
            return etree.fromstring(closed[0], RECOVERING) if closed else None
        return None


def _without_comments(text: str) -> str:
    """`text` with the line breaks of its comments alone."""
    return COMMENT.sub(lambda comment: "\n" * comment[0].count("\n"), text) if "<!--" in text else text


def parsed_xml(where: str, data: bytes, expected: str) -> etree._Element:
    """The root element of an XML document, without comments. where, expected: name of the file and what it should be.

    Raises InputError if the XML is broken, or has a document type definition, by which it could read other files or
    grow without end.
    """
    if b"<!DOCTYPE" in data.replace(b"\0", b""):  # also of UTF-16
        raise InputError(where, "", "a document type definition", "plain XML, which has none")
    try:
        return etree.fromstring(data, etree.XMLParser(remove_comments=True, remove_pis=True, **SAFE))
    except (etree.XMLSyntaxError, ValueError) as error:
        raise InputError(where, "", f"broken XML ({str(error)[:120]})", expected) from None
