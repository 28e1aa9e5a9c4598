"""The current pose of the live navigator beside the causal filter and the smoothed walk, for docs/results/live.md.

python scripts/live.py [WORDS] [--walks N] [--held-back] [--write] makes the rows whose "name: given" has one of some
words, separated by commas. Tune on the walks of development; the published table has simulated walks held back.
"""

import os
import sys
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from integrity_rows import HELD_BACK, is_wanted, make_rows
from live_cases import groups
from live_runs import followed
from live_scores import commonest, pooled, score_of
from recorded import percentiles
from tables import publish, table

from pdr_graph import smooth

DATA = Path(os.environ.get("PDR_GRAPH_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
MOST_RATIO, SHARE_OF_ROWS = 1.0, 0.95  # of the filter's mean error, in so many rows
LEAST_COVERAGE, MOST_OUTSIDE, MOST_JITTER, LONGEST = 0.87, 0.01, 0.2, 0.030  # targets: shares, [m], [s]
ACCURACY = ["walk", "given", "walks", "places", "current pose [m]", "filter [m]", "pose / filter", "in 90 %"]
ACCURACY += ["lag 60 s [m]", "batch [m]"]
BEHAVIOUR = ["walk", "given", "first pose [s]", "within 5 m [s]", "within 0.5 rad [s]", "jump in a minute [m]"]
BEHAVIOUR += ["causes", "drawn [m]", "outside", "jitter [m]", "push and pose, CPU [ms]", "wall [ms]"]


def live(data, wanted=(), walks=None, first=HELD_BACK):
    """Both tables. wanted: words of which a row has one; walks: simulated, in each row; first: seed of the first."""
    rows = [group for group in groups(data, walks, first) if is_wanted(group.title, wanted)]
    if not rows:
        raise SystemExit(f"no row has {' or '.join(map(repr, wanted))} in its name")
    found = scores_by_group(rows)
    rows = [(group, pooled(scores), len(scores)) for group, scores in zip(rows, found, strict=True) if scores]
    accuracy = table(ACCURACY, [accuracy_row(*row) for row in rows])
    behaviour = table(BEHAVIOUR, [behaviour_row(*row[:2]) for row in rows])
    publish("results/live.md", "live", f"{accuracy}\n\n{behaviour}\n\n{targets([score for _, score, _ in rows])}")


def scores_by_group(rows):
    """The scores of the walks of each group."""
    found = []
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        futures = [[pool.submit(score_case, case) for case in group.cases] for group in rows]
        for group, waiting in zip(rows, futures, strict=True):
            began = time.time()
            scores = [one.result() for one in waiting]
            found.append([score for score in scores if score is not None])
            print(f"{group.title}: {len(found[-1])} walks, {time.time() - began:.0f} s", file=sys.stderr, flush=True)
    return found


def score_case(make):
    """The score of one walk; None if nothing is left to be scored."""
    warnings.simplefilter("ignore")
    case = make()
    if case is None:
        return None
    return score_of(case, followed(case), smooth(case.graph()).trajectory)


def accuracy_row(group, score, walks):
    """Cells of the first table; those that miss a target are bold."""
    pose, filtered, lag, batch = (said(score.errors[name]) for name in ("pose", "filter", "lag", "batch"))
    share = marked(f"{100 * coverage(score):.0f} %", coverage(score) < LEAST_COVERAGE)
    beside = marked(f"{ratio(score):.2f}", ratio(score) > MOST_RATIO)
    return [group.name, group.given, walks, len(score.inside), pose, filtered, beside, share, lag, batch]


def behaviour_row(group, score):
    """Cells of the second table; those that miss a target are bold."""
    outside, jitter = outside_share(score), score.jitter.max(initial=0.0)
    times = [until(getattr(score, name)) for name in ("first", "near", "pointed")]
    return [
        group.name,
        group.given,
        *times,
        median_and_most(score.jumps),
        commonest(score.causes),
        median_and_most(score.display_jumps),
        "—" if np.isnan(outside) else marked(f"{100 * outside:.1f} %", outside > MOST_OUTSIDE),
        marked(median_and_most(score.jitter, 2), jitter > MOST_JITTER),
        milliseconds(score.cpu),
        milliseconds(score.wall),
    ]


def targets(scores):
    """How many rows reach each target, as text."""
    with_plan = [outside_share(score) for score in scores if not np.isnan(outside_share(score))]
    near = [ratio(score) <= MOST_RATIO for score in scores]
    covered = [coverage(score) >= LEAST_COVERAGE for score in scores]
    within = [share <= MOST_OUTSIDE for share in with_plan]
    return (
        f"The pose's mean error is at most {MOST_RATIO} times the filter's in {sum(near)} of {len(near)} rows (asked: "
        f"{100 * SHARE_OF_ROWS:.0f} %); its 90 % region has at least {100 * LEAST_COVERAGE:.0f} % in {sum(covered)} of "
        f"{len(covered)}; at most {100 * MOST_OUTSIDE:.0f} % of its places are outside the walkable area in "
        f"{sum(within)} of {len(within)} with a plan."
    )


def ratio(score):
    """The pose's mean error in the filter's."""
    return score.errors["pose"].mean() / score.errors["filter"].mean()


def coverage(score):
    """How often the truth is in the pose's 90 % region."""
    return score.inside.mean()


def outside_share(score):
    """How often the pose is outside the walkable area; NaN without a plan."""
    return score.outside.mean() if len(score.outside) else np.nan


def said(errors):
    return percentiles(errors) if len(errors) else "no pose"


def until(seconds):
    """Median and longest of some times ``(w,)`` [s]; "never" where it is infinite, a dash without truth."""
    seconds = seconds[~np.isnan(seconds)]
    both = [np.median(seconds), seconds.max()] if len(seconds) else []
    return " / ".join(f"{value:.0f}" if np.isfinite(value) else "never" for value in both[: len(seconds)]) or "—"


def median_and_most(values, digits=1):
    return " / ".join(f"{v:.{digits}f}" for v in (np.median(values), values.max())) if len(values) else "—"


def milliseconds(seconds):
    """Median, 99 % and longest; bold if that is too long."""
    text = " / ".join(f"{1e3 * v:.1f}" for v in np.percentile(seconds, [50, 99, 100]))
    return marked(text, seconds.max() > LONGEST)


def marked(text, missed):
    return f"**{text}**" if missed else text


if __name__ == "__main__":
    make_rows(lambda *row: live(DATA, *row), sys.argv[1:], __doc__, "simulated, in each row")
