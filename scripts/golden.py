"""Keep what the command line writes for many walks, and compare another version of the program with it.

scripts/golden record DIR, then scripts/golden compare DIR; CONTRIBUTING.md says more.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import IntEnum
from fnmatch import fnmatchcase
from pathlib import Path
from tempfile import TemporaryDirectory

from golden_cases import all_cases, make_inputs, simulations
from golden_files import VARYING, Difference, Rules, compare, read
from golden_program import DATA, ROOT, Case, CaseError, Program

Hashes = dict[str, dict[str, dict[str, str]]]  # by case, by file: of the numbers and of the texts


def main() -> int:
    """Run, and return the exit status: 1 if numbers differ or a case could not be run."""
    options = _options()
    program = Program(options.checkout.resolve(), options.folder.resolve())
    program.folder.mkdir(parents=True, exist_ok=True)
    program.check()
    if not DATA.is_dir():
        print(f"no real recordings at {DATA} (set PDR_GRAPH_DATA): their cases are left out")
    begin = time.monotonic()
    failed = (record if options.verb == "record" else compare_all)(program, options)
    print(f"{time.monotonic() - begin:.0f} s")
    return int(failed)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="scripts/golden", description=__doc__)
    parser.add_argument("verb", choices=("record", "compare"))
    parser.add_argument("folder", metavar="DIR", type=Path, help="where the recorded outputs and their hashes are")
    parser.add_argument("--only", metavar="PATTERN", default="*", help="only these cases, as in 'replay/*'")
    parser.add_argument("--checkout", metavar="PATH", type=Path, default=ROOT, help="whose command line; default: this")
    parser.add_argument("--jobs", metavar="N", type=int, default=2, help="cases that run at the same time; default: 2")
    parser.add_argument("--tolerance", metavar="METRES", type=float, default=0.0, help="accept smaller differences")
    parser.add_argument("--renamed", metavar="OLD=NEW", action="append", default=[], help="a key or name that changed")
    parser.add_argument("--ignored", metavar="KEY", action="append", default=[], help="a JSON key to leave out")
    return parser.parse_args()


def record(program: Program, options: argparse.Namespace) -> bool:
    """Run the cases and keep their outputs and hashes; return whether one failed."""
    hashes = _load(program)
    first = [case for case in simulations() if case.name not in hashes or fnmatchcase(case.name, options.only)]
    failures = _record(program, first, options.jobs, hashes)
    make_inputs(program.folder)
    rest = all_cases(program.folder)
    for name in hashes.keys() - {case.name for case in (*simulations(), *rest)}:
        del hashes[name]  # of an earlier list of cases
    rest = [case for case in rest if fnmatchcase(case.name, options.only)]
    failures += _record(program, rest, options.jobs, hashes)
    (program.folder / "hashes.json").write_text(json.dumps(hashes, indent=1, sort_keys=True))
    print(f"{len(first) + len(rest) - failures} cases recorded, {failures} failed")
    return failures > 0


def _record(program: Program, cases: list[Case], jobs: int, hashes: Hashes) -> int:
    """Run cases, enter their hashes and return how many failed."""
    failures = 0
    for case in _run(program, cases, program.folder, jobs):
        print(f"{case.name}: {case.problem or 'recorded'} ({case.seconds:.1f} s)", flush=True)
        failures += bool(case.problem)
        hashes.pop(case.name, None)
        if not case.problem:
            hashes[case.name] = _hashes(program.folder / case.name, Rules())
    return failures


def _load(program: Program) -> Hashes:
    path = program.folder / "hashes.json"
    return json.loads(path.read_text()) if path.exists() else {}


@dataclass(frozen=True)
class Outcome:
    """A case that was run, how long it took, and why it failed, "" if it did not."""

    name: str
    seconds: float
    problem: str = ""


def _run(program: Program, cases: Iterable[Case], parent: Path, jobs: int) -> Iterator[Outcome]:
    """Run cases in `parent`, and yield their outcomes in order."""

    def run(case: Case) -> Outcome:
        begin = time.monotonic()
        try:
            case.make(program, parent / case.name)
        except (CaseError, OSError) as error:
            return Outcome(case.name, time.monotonic() - begin, f"failed: {error}")
        return Outcome(case.name, time.monotonic() - begin)

    with ThreadPoolExecutor(jobs) as pool:
        yield from pool.map(run, cases)


def _hashes(folder: Path, rules: Rules) -> dict[str, dict[str, str]]:
    """The hashes of a case's files, by their recorded names."""
    return {name: read(path, rules).hashes() for name, path in _files(folder, rules).items()}


def _files(folder: Path, rules: Rules) -> dict[str, Path]:
    paths = sorted(filter(Path.is_file, folder.rglob("*")))
    return {rules.translate(str(path.relative_to(folder))): path for path in paths}


def compare_all(program: Program, options: argparse.Namespace) -> bool:
    """Run the recorded cases anew and print how they differ; return whether numbers do or a case failed."""
    hashes = {name: files for name, files in _load(program).items() if fnmatchcase(name, options.only)}
    cases = [case for case in (*simulations(), *all_cases(program.folder)) if case.name in hashes]
    renamed = {new: old for old, new in (pair.split("=") for pair in options.renamed)}
    rules = Rules(VARYING | set(options.ignored), renamed)
    verdicts = [Verdict.FAILED] * (len(hashes) - len(cases))  # their recordings are missing here
    with TemporaryDirectory(prefix="golden-") as parent:
        for case in _run(program, cases, Path(parent), options.jobs):
            old, new = program.folder / case.name, Path(parent) / case.name
            files = {} if case.problem else _differences(old, new, hashes[case.name], rules)
            worst = max((_verdict(file, options.tolerance) for file in files.values()), default=Verdict.FAILED)
            print("\n".join([f"{case.name}: {case.problem or worst.words}", *_lines(files)]), flush=True)
            verdicts.append(worst)
            shutil.rmtree(new, ignore_errors=True)
    print(f"{len(hashes)} cases: " + ", ".join(f"{verdicts.count(v)} {v.words}" for v in Verdict if v in verdicts))
    return any(verdict >= Verdict.NUMBERS for verdict in verdicts)


class Verdict(IntEnum):
    """How a file or a case compares with the recorded one; the larger, the worse."""

    SAME = 0
    TEXTS = 1
    TOLERATED = 2
    NUMBERS = 3
    FAILED = 4

    @property
    def words(self) -> str:
        """As it is printed."""
        return ("same", "texts differ", "numbers differ within the tolerance", "numbers differ", "failed")[self]


def _verdict(file: Difference, tolerance: float) -> Verdict:
    if not file.numbers:
        return Verdict.TEXTS if file.texts else Verdict.SAME
    return Verdict.TOLERATED if tolerance and file.size <= tolerance else Verdict.NUMBERS


def _differences(old: Path, new: Path, hashes: dict[str, dict[str, str]], rules: Rules) -> dict[str, Difference]:
    """The difference of each file of a case by its recorded name."""
    recorded, anew = _files(old, Rules()), _files(new, rules)
    files = {}
    for name in sorted(recorded | anew):
        if name not in anew or name not in recorded:
            files[name] = Difference(math.inf, "only recorded" if name in recorded else "only in the new version")
        elif read(anew[name], rules).hashes() == hashes.get(name):
            files[name] = Difference()
        else:
            files[name] = compare(recorded[name], anew[name], rules)
    return files


def _lines(files: dict[str, Difference]) -> Iterator[str]:
    """The files that differ, and how."""
    for name, difference in files.items():
        if difference.numbers:
            yield f"    {name}: numbers differ: {difference.numbers}"
        if difference.texts:
            yield f"    {name}: texts differ: {difference.texts}"


if __name__ == "__main__":
    sys.exit(main())
