"""Retired words stay out of names, docstrings, messages, web pages and docs (terms to use: docs/glossary.md)."""

import ast
import re

from source import FILES, PACKAGE, ROOT, text_of, tree_of

# Retired phrase, as a regular expression: the term to write instead
PHRASES = {
    r"\b[Bb]eware\b": "warnings",
    r"\bwild (?:fix|fixes|one|ones|time|positions?)\b|\bfor wild\b|\bfixes wild\b": "outlier; rejected as an outlier",
    r"\bcount(?:s|ed)? for nothing\b": "weight 0",
    r"\bis the prior's\b": "not observable from this walk; prior kept",
    r"\bprobability of this way\b": "probability of this route",
    r"\bnever heard of\b": "no data received",
    r"\bnobody recorded\b": "no data",
    r"\bailments?\b": "issues",
    r"\bput back\b": "clock reset",
    r"\bsettled\b|\bhanded out\b": "finalised",
    r"\bhalf of the moments\b": "median horizontal error",
    r"\b[Ww]hat the walk taught\b": "estimated calibration",
    r"\bsaid again\b|\bsays again\b": "duplicate epoch",
    r"\blaid on\b|\blaid out\b": "rigidly aligned; placed",
    r"\bpassed by\b": "skipped",
    r"\bas long as its history\b": "cost grows with the length of the history",
    r"\bthe nouns\b|^Nouns|\bThe house\b|\bAt the door\b": "data types; source layout; input validation",
    r"\btold from corners\b": "detected at corners",
    r"\bpose at once\b": "the current pose (causal estimate)",
    r"\bis said of\b|\bis not said\b|\bwhoever\b": "subject, verb, object",
    r"\bbegins? anew\b|\bmade anew\b|\blose their (?:grip|hold)\b": "restart; rebuild; lose weight",
}
# Retired names of modules, classes, functions, parameters and fields
NAMES = {"said", "told", "ailments", "settled", "believe", "believed", "judged", "slipping", "gripping", "laid", "lay"}
NAMES |= {"admit", "verbs", "take_in", "put_back", "from_where", "giving", "hiding", "blurring", "grouping", "joining"}
NAMES |= {"within_reach", "other_ends", "treads", "reholds", "bundles", "thickest", "Cloud", "Bank", "Tree", "Laid"}
NAMES |= {"Placed", "Past", "Seen", "Ground", "Form", "take_part", "wild"}

TEXTS = [
    *sorted(path for kind in ("html", "js", "css") for path in PACKAGE.glob(f"apps/*/web/*.{kind}")),
    *sorted((ROOT / "docs").rglob("*.md")),
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
]


def retired_phrases(*texts):
    """Each retired phrase of some texts, with the term to write instead."""
    lines = "\n".join(re.sub(r"\s+", " ", text) for text in texts)
    found = {term: re.search(retired, lines, re.MULTILINE) for retired, term in PHRASES.items()}
    return {f"{match[0]!r}: write {term}" for term, match in found.items() if match}


def strings(tree):
    """All string literals of a module, docstrings among them."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def identifiers(path):
    """The names that others see: module, classes, functions, parameters, fields and attributes."""
    yield path.stem
    for node in ast.walk(tree_of(path)):
        if isinstance(node, (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            yield node.name.lstrip("_")
        elif isinstance(node, ast.arg):
            yield node.arg.lstrip("_")
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            yield node.target.id.lstrip("_")
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.attr.lstrip("_")


def phrases_of(path):
    if path.suffix != ".py":
        return retired_phrases(text_of(path))
    comments = re.findall(r"(?<!\S)# (.*)", text_of(path))
    return retired_phrases(" ".join(comments), *strings(tree_of(path)))


def needed_in_errors(path):
    """Lines where an error's text says "needed": the word is "expected"."""
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Raise) and any("needed" in text for text in strings(node)):
            yield node.lineno


def offences(paths, search):
    return {path.relative_to(ROOT).as_posix(): found for path in paths if (found := list(search(path)))}


def test_no_retired_phrase_no_retired_name_and_errors_say_what_was_expected():
    assert offences([*FILES, *TEXTS], phrases_of) == {}
    assert offences(FILES, lambda path: NAMES.intersection(identifiers(path))) == {}
    assert offences(FILES, needed_in_errors) == {}


def test_the_search_finds_what_it_is_for(tmp_path):
    module = tmp_path / "told.py"
    module.write_text('def settled(said):\n    """A wild\n    fix."""\n    raise InputError("1 m needed")\n')
    assert phrases_of(module) == {"'wild fix': write outlier; rejected as an outlier"}
    assert NAMES.intersection(identifiers(module)) == {"told", "settled", "said"}
    assert list(needed_in_errors(module)) == [4]
