"""How far a GPS track leads by the recipes of others, for tests and tables: it calls nothing of the lifelog.

1. Wild fixes go: the track is cut where its speed is impossible, and parts of a few fixes are left out (Zheng,
   "Trajectory data mining: an overview", ACM TIST 6(3), 2015, Section 3.1, heuristics-based outlier detection).
2. A running median of five fixes (Section 3.1, mean and median filter), not over gaps.
3. Stay points (Li et al., "Mining user similarity based on location history", ACM GIS 2008, with their 200 m and 20
   minutes on GeoLife; trackintel's ``generate_staypoints`` is the same): from a fix on, until the first beyond that
   distance, if that is long. Nothing is gone in them.
4. The rest is added up, gaps of more than a minute left out.
"""

from itertools import pairwise

import numpy as np
from scipy.ndimage import median_filter

FASTEST = 40.0  # [m/s]
FEW = 5  # fixes in a part that is left out
MEDIAN = 5  # fixes
STAY, LASTING = 200.0, 1200.0  # [m], [s]
GAP = 60.0  # [s]


def without_wild(time, position):
    """Which fixes are left."""
    cut = np.flatnonzero(np.hypot(*np.diff(position, axis=0).T) > FASTEST * np.diff(time)) + 1
    parts = np.split(np.arange(len(time)), cut)
    return np.concatenate([part for part in parts if len(part) > FEW or len(parts) == 1])


def smoothed(time, position):
    """A running median of every part without a gap."""
    edge = [0, *(np.flatnonzero(np.diff(time) > GAP) + 1), len(time)]
    return np.concatenate([median_filter(position[a:b], (MEDIAN, 1), mode="nearest") for a, b in pairwise(edge)])


def stay_points(time, position, far=STAY, long=LASTING):
    """True of the fixes of a stay; one that nobody left is none."""
    stays, n = np.zeros(len(time), dtype=bool), 0
    while n < len(time):
        beyond = np.flatnonzero(np.hypot(*(position[n:] - position[n]).T) > far)
        if not len(beyond):
            break
        after = n + beyond[0]
        if time[after] - time[n] >= long:
            stays[n:after] = True
            n = after
        else:
            n += 1
    return stays


def raw_length(position):
    """The sum of all distances from fix to fix. [m]"""
    return float(np.hypot(*np.diff(position, axis=0).T).sum())


def cleaned_length(time, position, far=STAY, long=LASTING):
    """How far a track ``(n, 2)`` at ``time (n,)`` leads. [m]"""
    left = without_wild(time, position)
    time, position = time[left], smoothed(time[left], position[left])
    stays = stay_points(time, position, far, long)
    goes = (np.diff(time) <= GAP) & ~(stays[1:] & stays[:-1])
    return float(np.hypot(*np.diff(position, axis=0).T)[goes].sum())
