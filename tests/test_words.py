"""Retired words stay out of names, docstrings, messages, report texts and pages (docs/glossary.md has the terms)."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "pdr_graph"
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
# Retired names of modules, classes, functions, parameters and fields: the term to use instead
NAMES = {
    "said": "stated, reported",
    "told": "measurements, known",
    "ailments": "issues",
    "settled": "finalized",
    "believe": "longest_consistent_chain",
    "believed": "prior, expected",
    "judged": "reclassify",
    "slipping": "geman_mcclure_weight",
    "gripping": "huber_weight",
    "laid": "aligned, start",
    "lay": "initialize_from_batch",
    "admit": "build_recording",
    "verbs": "exit_codes",
    "take_in": "ingest",
    "put_back": "clock_resets",
    "from_where": "segment_start",
    "giving": "export",
    "hiding": "privacy",
    "blurring": "privacy",
    "grouping": "sessions",
    "joining": "sessions",
    "within_reach": "consistent_chains",
    "other_ends": "alternative_endings",
    "treads": "stairs",
    "reholds": "grip changes",
    "bundles": "path_modes",
    "thickest": "dominant_modes",
    "Cloud": "ParticleFilter",
    "Bank": "GaussianMixture",
    "Tree": "TransactionalISAM",
    "Laid": "BatchSolution",
    "Placed": "Georeferenced",
    "Past": "FinalizedTrajectory",
    "Seen": "KeyframeMeasurements",
    "Ground": "FloorSequence",
    "Form": "PositionFormat",
    "take_part": "run_trial",
    "wild": "outlier",
}
# Files that still have such words; this list may only become shorter
PENDING_PHRASES: set[str] = set()
PENDING_NAMES: set[str] = set()

MODULES = sorted(PACKAGE.rglob("*.py"))
TEXTS = [
    *(path for path in sorted((PACKAGE / "report").rglob("*")) if path.suffix in {".html", ".js", ".css"}),
    *sorted((ROOT / "docs").rglob("*.md")),
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
]


def name(path):
    return path.relative_to(ROOT).as_posix()


def retired_phrases(text):
    """Each retired phrase of a text, with the term to write instead."""
    joined = re.sub(r"\s+", " ", text)
    return {f"{found[0]!r}: write {term}" for retired, term in PHRASES.items() if (found := re.search(retired, joined))}


def strings(tree):
    """All string literals of a module, docstrings among them."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def identifiers(path, tree):
    """The names that others see: module, classes, functions, parameters, fields and attributes."""
    yield path.stem
    for node in ast.walk(tree):
        if isinstance(node, (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            yield node.name.lstrip("_")
        elif isinstance(node, ast.arg):
            yield node.arg.lstrip("_")
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            yield node.target.id.lstrip("_")
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.attr.lstrip("_")


def phrases_of(path):
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        return retired_phrases(text)
    comments = re.findall(r"(?<!\S)# (.*)", text)
    return retired_phrases(" ".join(comments)).union(*map(retired_phrases, strings(ast.parse(text))))


def names_of(path):
    found = set(identifiers(path, ast.parse(path.read_text(encoding="utf-8"))))
    return {f"{one!r}: use {NAMES[one]}" for one in found & NAMES.keys()}


def needed_in_errors(path):
    """Lines where an error's text says "needed": the word is "expected"."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        raised = node.exc if isinstance(node, ast.Raise) else None
        if raised is not None and any("needed" in text for text in strings(raised)):
            yield node.lineno


def offences(paths, search, pending=frozenset()):
    """What a search finds, by file, in the files that are not in a list of pending ones."""
    return {name(path): found for path in paths if name(path) not in pending and (found := list(search(path)))}


def test_no_retired_phrases():
    assert offences([*MODULES, *TEXTS], phrases_of, PENDING_PHRASES) == {}


def test_no_retired_names():
    assert offences(MODULES, names_of, PENDING_NAMES) == {}


def test_errors_say_what_was_expected():
    assert offences(MODULES, needed_in_errors) == {}


def test_pending_lists_name_only_files_that_need_it():
    """A file that was reworded leaves the list."""
    named = {name(path): path for path in [*MODULES, *TEXTS]}
    assert {one for one in PENDING_PHRASES if one not in named or not phrases_of(named[one])} == set()
    assert {one for one in PENDING_NAMES if one not in named or not names_of(named[one])} == set()


def test_the_check_finds_what_it_is_for(tmp_path):
    module = tmp_path / "told.py"
    module.write_text(
        'def settled(said):\n    """A wild fix,\n    counted for nothing."""\n    raise InputError("1 m needed")\n'
    )
    assert len(phrases_of(module)) == 2
    assert len(names_of(module)) == 3
    assert list(needed_in_errors(module)) == [4]
