"""The tables of docs/accuracy.md: rows and sums of the tables in docs/results/, without a new computation.

python scripts/accuracy_page.py [--write]; `scripts/reproduce NAME --write` does it too.
"""

import re

from tables import publish, published, table

LOWEST = 0.85  # of the places have to lie in the stated 90 % region
HONEST = (": none", ": the published list", ": the list put right")
EMPHASIS = re.compile(r"\*\*")


def accuracy_page():
    """Print the tables of docs/accuracy.md; with --write put them there."""
    for name, make in TABLES.items():
        publish("accuracy.md", name, make())
    publish("../README.md", "walks", readme())


def plain(cell):
    """A cell without emphasis."""
    return EMPHASIS.sub("", cell)


def outdoors():
    """Simulated receivers and the campus walk: errors, share in the region, its radius."""
    simulated = ["GNSS", "GNSS: 5 s late", "GNSS: 10 m off"]
    rows = [integrity("integrity", "outdoors", given, f"simulated walks, {given}") for given in simulated]
    campus = ["one in 60 s"]
    return region_table(
        rows + [integrity("integrity recorded", "NJU campus", given, f"campus, GPS {given}") for given in campus]
    )


def outage():
    """Mean error within an outage of the GPS by three methods."""
    methods = ("product: Kalman filter, causal", "product: RTS smoother", "**product: graph**")
    tables = [rows for rows in published("results/seeds.md", "gps-dr") if "mean [m]" in rows[0]]
    rows = []
    for length, of_length in zip(("none", "20 s", "2 min"), tables, strict=False):
        mean = {row["method"]: row["mean [m]"] for row in of_length}
        rows.append([length, *(mean[method] for method in methods)])
    return table(["outage", "filter: mean [m]", "smoothed filter (RTS)", "graph"], rows)


def plan():
    """Walks in malls: median and 95 % by six methods, with intervals those of the graph."""
    methods = {
        "dead reckoning": "dead reckoning",
        "filter": "filter (causal)",
        "RTS": "filter, smoothed (RTS)",
        "graph": "graph",
        "particles, plan": "particles with map",
        "graph, plan": "graph with map",
    }
    rows = []
    for given in ("every second waypoint", "first and last", "first only"):
        found = [record("microsoft", "microsoft", given, method) for method in methods.values()]
        pairs = [
            [one[column] if name.startswith("graph") else one[column].split()[0] for column in ("CE50 [m]", "CE95 [m]")]
            for name, one in zip(methods, found, strict=True)
        ]
        rows.append([given, *map(" / ".join, pairs), found[-1]["in 90 % region"]])
    return table(["positions given", *(f"{name} [m]" for name in methods), "in 90 % region"], rows)


README = {  # rows of its table: those of the page of walks in malls
    "every second waypoint: **graph**": ("every second waypoint", "graph"),
    "first and last: dead reckoning, rigidly aligned": ("first and last", "dead reckoning"),
    "first and last: Kalman filter and smoother (RTS)": ("first and last", "filter, smoothed (RTS)"),
    "first and last: **graph**": ("first and last", "graph"),
    "first and last, floor plan: particle filter, mean of whole paths": ("first and last", "particles with map"),
    "first and last, floor plan: **graph**": ("first and last", "graph with map"),
    "first, direction by the magnetometer: **graph**": ("first only", "graph"),
    "first, floor plan: particle filter": ("first only", "particles with map"),
    "first, floor plan: **graph**": ("first only", "graph with map"),
}


def readme():
    """The table of README."""
    rows = []
    for label, keys in README.items():
        found = record("microsoft", "microsoft", *keys)
        rows.append([label, *(found[f"CE{p} [m]"] for p in (50, 95)), found["in 90 % region"]])
    return table(["given to the estimate", *(f"CE{p} [m]" for p in (50, 95)), "in 90 % region"], rows)


def beacons():
    """Beacons, simulated and of museum logs."""
    given = ["beacons", "GNSS, beacons", "GNSS, beacons: of another building", "beacons: a pair swapped"]
    rows = [integrity("integrity", "indoors", one, f"simulated walks, {one}") for one in given]
    museum = "IPIN 2023, all", "GNSS, beacons: the published list"
    logs = record("integrity", "integrity recorded", *museum)["walks"]
    return region_table([*rows, integrity("integrity recorded", *museum, f"{logs} museum logs, {museum[1]}")])


def live():
    """The current pose beside the causal filter, the smoothed walk and the batch solution."""
    shown = {
        "Microsoft": ["first and last", "first only, plan"],
        "NJU campus": ["one in 60 s"],
        **{f"Trial{name}": ["GNSS, beacons"] for name in ("24_repetition03", "52_repetition01")},
        "simulated": ["outdoors", "indoors, start, compass, plan", "indoors, GNSS, beacons"],
        "scenario": ["mall"],
    }
    columns = ["current pose [m]", "filter [m]", "in 90 %", "batch [m]"]
    rows = [
        [f"{walk.split('_')[0]}: {given}", *(ends(plain(record("live", "live", walk, given)[c])) for c in columns)]
        for walk, several in shown.items()
        for given in several
    ]
    return table(["recordings: given", *columns], rows)


def lifelog():
    """Stays of simulated days, and visits of shop fronts."""
    stays = published("results/lifelog.md", "lifelog-simulated-days")[0]
    visits = record("lifelog", "lifelog-visits", "all")
    rows = []
    for row in stays:
        kind = f"stays of {row['true stays']}" if "min" in row["true stays"] else "longer stays"
        found = int(row["number"]) - int(row["missed"])
        rows.append([kind, row["number"], f"{found} found", f"{row['start and end off: median']} off"])
    right, off = f"{visits['named right']} right", f"{visits['off [m]: median']} m off"
    rows.append(["visits of shops", visits["visits"], right, off])
    return table(["simulated days", "number", "found", "median"], rows)


def trust():
    """How often the stated 90 % region holds the truth, with honest sources and with one that is wrong."""
    rows = [
        {"": f"{title}, {row['sources']}"} | row
        for title, name in (("simulated walks", "integrity"), ("recorded walks", "integrity recorded"))
        for row in published("results/integrity.md", name)[-1]
    ]
    header = [name for name in rows[0] if name != "sources"]
    return table(header, [[row[name] for name in header] for row in rows])


def regions(header, lines):
    """A table of regions, and its sums: over rows with honest sources, and over those with one that is wrong."""
    sources = [dict(zip(header, line, strict=True)) for line in lines]
    rows = []
    for wrong in (False, True):
        some = [row for row in sources if is_wrong(row["given"]) is wrong and "all" not in row.get("recordings", "")]
        if not some:
            continue
        shares = [share(row["in 90 % region"]) for row in some]
        walks = [int(row["walks"]) for row in some]
        beyond = sum(int(plain(row["mean over 3 × r95"]).split()[0]) for row in some)
        doubted = sum(share(row["not ok"]) * n for row, n in zip(some, walks, strict=True)) / sum(walks)
        low = sum(one < LOWEST for one in shares)
        case = "one source wrong" if wrong else "honest sources"
        rows.append([case, len(some), percent(min(shares)), low, f"{beyond} of {sum(walks)}", percent(doubted)])
    sums = ["sources", "cases", "lowest share in region", f"cases below {percent(LOWEST)}"]
    sums += ["walks with mean error beyond 3 × r95", "walks not `ok`"]
    return f"{table(header, lines)}\n\n{table(sums, rows)}"


def misses():
    """Every case of the table of integrity whose 90 % region holds less than it has to."""
    rows = [
        [f"{row['']}: {row['given']}", row["error [m]"], plain(row["in 90 % region"]), row["not ok"]]
        for row in published("results/integrity.md", "integrity")[0]
        if share(row["in 90 % region"]) < LOWEST
    ]
    return table(["simulated walks: given", "error [m]", "in 90 % region", "not `ok`"], rows)


def is_wrong(given):
    """True if one of a row's sources is wrong: all that stands behind a colon, but for what is in `HONEST`."""
    for honest in HONEST:
        given = given.replace(honest, "")
    return ":" in given


def percent(number):
    """A share as a cell."""
    return f"{100 * number:.0f} %"


def share(cell):
    """A cell in percent as a number, without its interval; 0 for none."""
    number = re.match(r"\d+", plain(cell))
    return float(number[0]) / 100 if number else 0.0


def ends(cell):
    """The first and the last of three figures; other cells as they are."""
    parts = cell.split(" / ")
    return f"{parts[0]} / {parts[-1]}" if len(parts) == 3 else cell


def integrity(name, place, given, label):
    """A row of the table of regions."""
    found = record("integrity", name, place, given)
    return [label, *(plain(found[c]) for c in ("error [m]", "in 90 % region", "its radius [m]", "not ok"))]


def region_table(rows):
    """Rows of `integrity` under their header."""
    return table(["walks and sources", "error [m]", "in 90 % region", "its radius [m]", "not `ok`"], rows)


def record(page, name, *keys):
    """The row of a published table that begins with these cells."""
    rows = [row for row in published(f"results/{page}.md", name)[0] if list(row.values())[: len(keys)] == list(keys)]
    if len(rows) != 1:
        raise SystemExit(f"docs/results/{page}.md, {name}: {len(rows)} rows begin with {keys}, expected 1")
    return rows[0]


TABLES = {
    "outdoors": outdoors,
    "outage": outage,
    "plan": plan,
    "beacons": beacons,
    "live quality": live,
    "diary": lifelog,
    "trust": trust,
    "misses": misses,
}


if __name__ == "__main__":
    accuracy_page()
