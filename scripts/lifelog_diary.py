"""Stays of a diary beside a published recipe on real days, and beside the truth on simulated days.

python scripts/lifelog_diary.py: both tables of docs/results/lifelog.md.
"""

import os
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from tables import publish, table

from pdr_graph.apps.lifelog.build import build
from pdr_graph.apps.lifelog.diary import diary
from pdr_graph.apps.lifelog.ingest import add
from pdr_graph.apps.lifelog.stays_and_legs import SHORTEST_VISIT
from pdr_graph.apps.lifelog.store import Store
from pdr_graph.apps.lifelog.timeline import STAY

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("PDR_GRAPH_DATA", ROOT.parent / "shared" / "data"))
GEOLIFE = ("000", "001", "005", "010")
PEOPLE, DAYS = range(1, 13), 4  # of the simulation; constants were chosen on the real days
OVERLAP = 0.5  # intersection over union from which two stays are one
LENGTHS = {"5 to 15 min": (300.0, 900.0), "15 to 60 min": (900.0, 3600.0), "longer": (3600.0, np.inf)}


@dataclass(frozen=True)
class Comparison:
    """Stays ``(start, end)`` [s] of a diary beside others."""

    ours: list
    others: list

    @property
    def matched(self):
        """Pairs (ours, other) of one stay."""
        left, found = list(self.ours), []
        for other in self.others:
            best = max(left, key=lambda one: overlap(one, other), default=None)
            if best is not None and overlap(best, other) >= OVERLAP:
                found.append((best, other))
                left.remove(best)
        return found

    @property
    def f1(self):
        """Harmonic mean of precision and recall."""
        return 2 * len(self.matched) / max(len(self.ours) + len(self.others), 1)

    @property
    def times(self):
        """Sum of ours and of the others [s]."""
        return tuple(sum(end - start for start, end in stays) for stays in (self.ours, self.others))


def overlap(one, other):
    """Intersection over union of two stays."""
    return (min(one[1], other[1]) - max(one[0], other[0])) / (max(one[1], other[1]) - min(one[0], other[0]))


def lifelog_diary(data=DATA):
    """Both tables."""
    publish("results/lifelog.md", "lifelog-recipe", recipe_table(data))
    publish("results/lifelog.md", "lifelog-simulated-days", simulated_table())


def recipe_table(data=DATA):
    """The stays of real days beside those of trackintel, with and without a limit of silences."""
    rows, sums = [], {}
    for person in GEOLIFE:
        with TemporaryDirectory() as folder:
            ours, count = stays_of([data / "geolife_sample" / person], Path(folder) / "log")
        for gap in (15.0, np.inf):
            found = Comparison(ours, recipe(data, person, gap))
            before = sums.get(gap, Comparison([], []))
            sums[gap] = Comparison(before.ours + found.ours, before.others + found.others)
            rows.append([f"GeoLife {person}", limit(gap), str(count), *columns(found)])
    rows += [["**all**", limit(gap), "", *columns(found)] for gap, found in sums.items()]
    header = [
        "day",
        "silences in a stay",
        "rows of the diary",
        "stays: ours",
        "trackintel's",
        "in both",
        "F1",
        "time: ours",
        "trackintel's",
    ]
    return table(header, rows)


def limit(gap):
    return "any" if np.isinf(gap) else f"{gap:.0f} min"


def columns(found):
    ours, others = found.times
    return [
        str(len(found.ours)),
        str(len(found.others)),
        str(len(found.matched)),
        f"{found.f1:.2f}",
        f"{ours / 60:.0f} min",
        f"{others / 60:.0f} min",
    ]


def stays_of(recordings, log):
    """The stays at places of a diary, joined over midnights, and its number of rows."""
    add(log, recordings)
    build(log)
    with Store(log) as store:
        days = diary(store, "me").days
    found = []
    for row in (row for day in days for row in day.entries if row.kind == STAY and row.place_number > 0):
        if found and row.start - found[-1][1] < 1 and row.place_number == found[-1][2]:
            found[-1] = (found[-1][0], row.end, row.place_number)
        else:
            found.append((row.start, row.end, row.place_number))
    return [stay[:2] for stay in found], sum(len(day.entries) for day in days)


def recipe(data, person, gap):
    """Stays ``(start, end)`` [s] by trackintel: stay points of 100 m and 5 min, merged at one location within 10 min.

    gap: longest silence within a stay point [min].
    """
    import geopandas
    import pandas
    import trackintel
    from trackintel.preprocessing import generate_locations, generate_staypoints

    names = ["lat", "lon", "zero", "altitude", "days", "date", "time"]
    [file] = sorted((data / "geolife_sample" / person).glob("*.plt"))
    rows = pandas.read_csv(file, skiprows=6, header=None, names=names)
    rows["tracked_at"], rows["user_id"] = pandas.to_datetime(rows.date + " " + rows.time, utc=True), 0
    points = geopandas.points_from_xy(rows.lon, rows.lat)
    fixes = geopandas.GeoDataFrame(rows[["user_id", "tracked_at"]], geometry=points, crs=4326).rename_geometry("geom")
    options = {"dist_threshold": 100, "time_threshold": 5.0, "gap_threshold": min(gap, 1e6), "include_last": True}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        _, stays = generate_staypoints(trackintel.Positionfixes(fixes), method="sliding", **options)
        stays, _ = generate_locations(stays, epsilon=100, num_samples=1, agg_level="dataset")
    merged = []
    for stay in stays.sort_values("started_at").itertuples():
        start, end = stay.started_at.timestamp(), stay.finished_at.timestamp()
        if merged and merged[-1][2] == stay.location_id and start - merged[-1][1] < 600:
            merged[-1] = (merged[-1][0], end, stay.location_id)
        else:
            merged.append((start, end, stay.location_id))
    return [stay[:2] for stay in merged]


def simulated_table(people=PEOPLE, days=DAYS):
    """The stays of simulated days beside the true ones."""
    made = [simulated(person, days) for person in people]
    found = [comparison for comparison, _ in made]
    rows = [lengths_row(name, bounds, found) for name, bounds in LENGTHS.items()]
    ours, others = np.sum([comparison.times for comparison in found], axis=0)
    matched, true, all_ = (
        sum(map(len, own)) for own in zip(*((c.matched, c.others, c.ours) for c in found), strict=True)
    )
    text = table(["true stays", "number", "missed", "start and end off: median", "90 %"], rows)
    text += f"\n\nF1 {2 * matched / (true + all_):.2f}; {all_ - matched} stays of {len(people) * days} days are at no "
    text += f"true one of 5 min or more; time at places {100 * (ours / others - 1):+.1f} %; "
    return text + f"{sum(count for _, count in made) / len(people) / days:.0f} rows a day."


def lengths_row(name, bounds, found):
    """The row of the true stays of some lengths."""
    own = [stay for comparison in found for stay in comparison.others if is_between(stay, bounds)]
    hit = [pair for comparison in found for pair in comparison.matched if is_between(pair[1], bounds)]
    off = np.abs([np.subtract(one, other) for one, other in hit]) / 60
    times = [f"{np.quantile(off, share):.1f} min" for share in (0.5, 0.9)]
    return [name, str(len(own)), str(len(own) - len(hit)), *times]


def is_between(stay, bounds):
    return bounds[0] <= stay[1] - stay[0] < bounds[1]


def simulated(person, days):
    """Stays of a diary beside the true ones, and its number of rows."""
    sys.path.append(str(ROOT / "tests" / "lifelog"))
    from gps_days import gps_day, true_stays

    made = [gps_day(person, number) for number in range(days)]
    with TemporaryDirectory() as folder:
        for number, day in enumerate(made):
            day.write(Path(folder) / "raw" / f"{number}.plt")
        ours, count = stays_of([Path(folder) / "raw"], Path(folder) / "log")
    return Comparison(ours, [stay[:2] for stay in true_stays(made, SHORTEST_VISIT)]), count


if __name__ == "__main__":
    lifelog_diary()
