"""Damage inputs and stores many times.

python scripts/fuzz.py [COUNT] [NAME …]          each kind of input loads or is refused in one line, soon
python scripts/fuzz.py walks FOLDER [COUNT]      recordings with their truth, as misread (units, clocks, columns): a
                                                 result or one line, and "ok" only near the truth
python scripts/fuzz.py stores [COUNT] [NAME …]   files of a journal, a lifelog and a live session, as power cuts do:
                                                 counts what comes back; COUNT: of each kind of damage
"""

import random
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import numpy as np
from misread_walks import WRONG, misread, misread_walk, walks_in
from mutations import PLAN_SCALES, inputs, mutated, simulated_if_short
from power_loss import DAMAGES, FAILED, OUTCOMES, TARGETS, count

from pdr_graph import InputError, detect_steps, read_fixes, read_trajectory
from pdr_graph.floor.check import problems
from pdr_graph.floor.plan_files import Building
from pdr_graph.io.loading import load
from pdr_graph.types import Recording, Signal

SLOWEST = 10  # [s] for inputs of some kilobytes


def record(path):
    walk = load(path)
    if walk.has_acceleration:
        detect_steps(walk)


def fixes(path):
    read_fixes(path, Recording("walk", 1.7e9, 1.7e9, accelerometer=Signal(np.arange(0, 60, 0.02), np.zeros((3000, 3)))))


def late(*_):
    raise TimeoutError(f"more than {SLOWEST} s")


def fuzz(name, file, whole, use, number, folder):
    """Failures among ``number`` damaged copies; these are kept beside their traceback."""
    loaded, failures, started, path = 0, 0, time.time(), folder / file
    for n in range(number):
        data = mutated(whole, random.Random(f"{name}{n}"))
        path.write_bytes(data)
        signal.alarm(SLOWEST)
        try:
            use(path)
            loaded += 1
        except InputError as refusal:
            if "\n" in str(refusal) or len(str(refusal)) > 1000:
                failures += 1
                print(f"{name} {n}: a long refusal: {str(refusal)[:300]!r}")
        except Exception:
            failures += 1
            Path(f"{name}-{n}-{file}".replace(" ", "_")).write_bytes(data)
            print(f"{name} {n}:", *traceback.format_exc().splitlines()[-7:], sep="\n  ")
        signal.alarm(0)
    took = time.time() - started
    print(f"{name}: {number} damaged, {loaded} loaded, {failures} failures, {took:.0f} s", flush=True)
    return failures


def fuzz_inputs(number, wanted):
    """Failures of all kinds of input."""
    warnings.simplefilter("error")  # a warning is a line of noise on a user's terminal
    signal.signal(signal.SIGALRM, late)
    recordings, tables, plans = inputs()
    cases = [(name, *whole, record) for name, whole in recordings.items()]
    for name, whole in plans.items():
        cases.append((name, *whole, lambda path, scale=PLAN_SCALES.get(name): problems(Building.load(path, scale))))
    uses = {"scenario": simulated_if_short, "fixes": fixes, "trajectory": read_trajectory}
    cases += [(name, *tables[name], use) for name, use in uses.items()]
    with tempfile.TemporaryDirectory() as folder:
        return sum(fuzz(*case, number, Path(folder)) for case in cases if not wanted or case[0] in wanted)


def fuzz_stores(number, wanted):
    """Failures of all kinds of store; a row of outcomes for each kind of damage."""
    print(f"{'kind of file':<28}{'damage':<8}" + "".join(f"{name:>20}" for name in OUTCOMES))
    failures = 0
    for name, make in TARGETS.items():
        if wanted and name not in wanted:
            continue
        with tempfile.TemporaryDirectory() as folder:
            made = Path(folder) / "made"
            made.mkdir()
            target = make(made)
            for damage in DAMAGES:
                began = time.time()
                outcomes = count(target, damage, number, made / "store", lambda line: print("  " + line))
                row = "".join(f"{outcomes[outcome]:>20}" for outcome in OUTCOMES)
                print(f"{name:<28}{damage:<8}{row}   {time.time() - began:.0f} s", flush=True)
                failures += outcomes[FAILED]
    return failures


CPU = 10.0  # [s] per 10 MB of a file


def fuzz_walks(folder, number):
    """Failures of the estimates of misread recordings of a folder; a row for each, and the sums."""
    whole, outcomes, failures = walks_in(folder), Counter(), list[str]()
    print(f"{len(whole)} recordings with a truth", flush=True)
    for n in range(number):
        chance = random.Random(n)
        path = chance.choice(list(whole))
        what, data = misread(path.read_bytes(), chance)
        began = time.process_time()
        with tempfile.TemporaryDirectory() as copy:
            outcome, text = misread_walk(Path(copy) / path.name, data, whole[path])
        took = time.process_time() - began
        if took > max(CPU, CPU * len(data) / 1e7):
            outcome, text = "slow", f"{took:.0f} s"
        outcomes[outcome] += 1
        if outcome in ("slow", *WRONG):
            failures.append(f"{n} {path.name}: {what}: {outcome} {text}")
            print(failures[-1], flush=True)
    print(", ".join(f"{count} {name}" for name, count in outcomes.most_common()))
    return len(failures)


def main():
    arguments = sys.argv[1:]
    if arguments[:1] == ["walks"]:
        sys.exit(fuzz_walks(Path(arguments[1]), int((*arguments[2:], "200")[0])) > 0)
    stores = arguments[:1] == ["stores"]
    number, *wanted = arguments[stores:] or ["250" if stores else "1000"]
    sys.exit((fuzz_stores if stores else fuzz_inputs)(int(number), wanted) > 0)


if __name__ == "__main__":
    main()
