"""When a live smoother refines, reviews, searches and restarts its estimate."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Schedule:
    """When the live smoother refines, reviews and restarts its estimate. All values are chosen by hand.

    rounds: relinearisations after a keyframe, one with each of the next steps; wall_pieces: last pieces whose walls are
    associated again at a keyframe.
    final_rounds: most linearisations at the end of the walk.
    batch_interval [s], batch_share: the batch solves an ambiguous walk again after this time and this share of the
    walk's duration, whichever is longer, and its solution is adopted batch_time [s] later; longest_ambiguous: time [s]
    after which the most probable path is accepted if there are three fixes; longest_open: duration of the window [s]
    after which keyframes leave it although the direction is open; batch_rounds: most relinearisations of a path of the
    batch before it is compared with the present one.
    comparison_interval [s], comparison_share: the sources are compared again after this share of the walk's duration,
    between 5 s and comparison_interval, and the result is adopted comparison_time [s] later.
    review_after: time [s] after which the batch solves a walk on a plan once more, while all of it is in the window.
    search_after: time [s] from which a walk without position is sought on the plan, since a shorter one fits too many
    places; search_interval [s], search_share: it is sought again after this time and this share of the walk's duration,
    whichever is longer, and the result is adopted search_time [s] later; longest_search: time [s] after which the
    search is given up, since the whole walk is kept for it.
    cost_interval: keyframes between checks of the cost; cost_base, cost_per_keyframe, cost_per_fix: the limit of the
    cost, twice that of correct walks.
    """

    rounds: int = 4
    wall_pieces: int = 60
    final_rounds: int = 30
    batch_interval: float = 3.0
    batch_share: float = 0.2
    batch_time: float = 1.0
    batch_rounds: int = 12
    longest_ambiguous: float = 180.0
    longest_open: float = 900.0
    comparison_interval: float = 30.0
    comparison_share: float = 0.5
    comparison_time: float = 2.0
    review_after: float = 50.0
    search_after: float = 20.0
    search_interval: float = 20.0
    search_share: float = 0.4
    search_time: float = 10.0
    longest_search: float = 900.0
    cost_interval: int = 5
    cost_base: float = 8.0
    cost_per_keyframe: float = 0.4
    cost_per_fix: float = 3.0

    def batch_delay(self, duration: float) -> float:
        """Time [s] until the batch solves an ambiguous walk of this duration [s] again."""
        return max(self.batch_interval, self.batch_share * duration)

    def comparison_delay(self, duration: float) -> float:
        """Time [s] until the sources of a walk of this duration [s] are compared again."""
        return min(max(5.0, self.comparison_share * duration), self.comparison_interval)

    def search_delay(self, duration: float) -> float:
        """Time [s] until a walk of this duration [s] is sought on the plan again."""
        return max(self.search_interval, self.search_share * duration)

    def cost_limit(self, keyframes: int, fixes: int) -> float:
        """Cost above which a window with so many keyframes and fixes cannot be on the correct path."""
        return self.cost_base + self.cost_per_keyframe * keyframes + self.cost_per_fix * fixes


SCHEDULE = Schedule()
