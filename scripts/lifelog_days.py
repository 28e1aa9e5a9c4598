"""What days of GPS alone are made of, and how far they led: GeoLife and GPX, beside a cleaning by others' recipes."""

import os
import sys
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from tables import publish, table

from pdr_graph.apps.lifelog.day import GAP, STANDING, VEHICLE, WALKING
from pdr_graph.apps.lifelog.stays import follow_positions
from pdr_graph.walk import read

ROOT = Path(__file__).resolve().parents[1]
ON_FOOT = {"walk", "run"}
COLOURS = {WALKING: "tab:green", STANDING: "tab:red", VEHICLE: "tab:blue", GAP: "0.5"}


def lifelog_days(data):
    """Both tables: the days, and what GeoLife's volunteer said beside what was found."""
    rows = []
    for path in days(data):
        fixes, segments, raw, clean, gone = lengths(path)
        row = [name(path), hours(fixes.time[-1] - fixes.time[0])]
        row += [f"{hours(total(segments, kind)[0])}, {km(total(segments, kind)[1])}" for kind in (WALKING, VEHICLE)]
        row += [f"{hours(total(segments, STANDING)[0])}, {sum(s.kind == STANDING for s in segments)}"]
        row += [f"{hours(total(segments, GAP)[0])}, {sum(s.kind == GAP for s in segments)}"]
        rows.append([*row, km(raw), km(clean), km(gone), off(gone, clean)])
    header = [
        "day",
        "in all",
        "walking",
        "vehicle",
        "standing, times",
        "gaps",
        "raw",
        "cleaned",
        "ours",
        "difference",
    ]
    publish("results/lifelog.md", "lifelog-days", f"{table(header, rows)}\n\n{said_and_found(data)}")


def lengths(path):
    """A day's fixes and segments, and how far it led [m]: as recorded, cleaned by others' recipes, and by us."""
    sys.path.append(str(ROOT / "tests"))
    from cleaned_track import cleaned_length, raw_length

    fixes = read(path).fixes
    _, segments = follow_positions(fixes)
    clean = cleaned_length(fixes.time, fixes.position)
    return fixes, segments, raw_length(fixes.position), clean, sum(s.distance for s in segments)


def off(length, clean):
    return f"{100 * (length / clean - 1):+.1f} %"


def days(data):
    """The files."""
    return [*sorted(data.glob("geolife_sample/*/*.plt")), *sorted(data.glob("gpx_sample/*.gpx"))]


def name(path):
    return f"GeoLife {path.parent.name}" if path.suffix == ".plt" else path.stem


def hours(seconds):
    return f"{seconds / 3600:.2f} h"


def km(metres):
    return f"{metres / 1000:.2f} km"


def total(segments, kind):
    """Time [s] and distance [m] of all of one kind."""
    own = [s for s in segments if s.kind == kind]
    return sum(s.end - s.start for s in own), sum(s.distance for s in own)


def labels(path):
    """What a volunteer said: Unix times from when to when, and whether on foot; the shortest first, as they overlap."""
    rows = [line.split("\t") for line in path.read_text().splitlines()[1:]]
    said = [(unix(begin), unix(end), mode.strip() in ON_FOOT) for begin, end, mode in rows]
    return sorted(said, key=lambda one: one[1] - one[0])


def unix(text):
    return datetime.strptime(text, "%Y/%m/%d %H:%M:%S").replace(tzinfo=UTC).timestamp()


def agreement(data):
    """Time [s] by what was said (on foot, in a vehicle) and found (walking or standing, in a vehicle) ``(2, 2)``."""
    (path,) = data.glob("geolife_sample/010/*.plt")
    given = read(path)
    _, segments = follow_positions(given.fixes)
    said, result = labels(path.with_name("labels.txt")), np.zeros((2, 2))
    for segment in segments:
        if segment.kind == GAP:
            continue
        for second in np.arange(segment.start, segment.end):
            at = given.walk.epoch + second
            on_foot = next((foot for begin, end, foot in said if begin <= at <= end), None)
            if on_foot is not None:
                result[int(not on_foot), int(segment.kind == VEHICLE)] += 1
    return result


def said_and_found(data):
    """GeoLife 010 beside its labels."""
    both = agreement(data)
    rows = [[said, *(f"{t / 60:.1f} min" for t in row)] for said, row in zip(("walk", "taxi, bus"), both, strict=True)]
    return table(["said", "found on foot", "found in a vehicle"], rows)


def draw(path, out):
    """A picture of one day: its way by what was done, and when."""
    import matplotlib.pyplot as plt

    fixes = read(path).fixes
    way, segments = follow_positions(fixes)
    figure, (plan, hour) = plt.subplots(2, 1, figsize=(14, 14), height_ratios=[5, 1], layout="constrained")
    plan.plot(*fixes.position.T, ".", color="0.8", markersize=2)
    for s in segments:
        own = way.position[(way.time >= s.start) & (way.time <= s.end)]
        plan.plot(*own.T, ":" if s.kind == GAP else "-", color=COLOURS[s.kind], lw=4 if s.kind == STANDING else 1.5)
        speed = s.distance / (s.end - s.start)
        hour.bar(s.start / 3600, max(speed, 0.3), (s.end - s.start) / 3600, align="edge", color=COLOURS[s.kind])
    low, high = np.percentile(way.position, [0, 100], axis=0)
    plan.set(aspect="equal", xlim=(low[0] - 50, high[0] + 50), ylim=(low[1] - 50, high[1] + 50), title=name(path))
    hour.set(xlabel="h", ylabel="m/s")
    figure.savefig(out, dpi=70)
    plt.close(figure)


if __name__ == "__main__":
    shared = Path(os.environ.get("PDR_GRAPH_DATA", ROOT.parent / "shared" / "data"))
    lifelog_days(shared)
    for folder in sys.argv[1:2]:
        for file in days(shared):
            draw(file, Path(folder) / f"day_{file.parent.name}.png")
