"""A recording as if it were coming in live: what ``pdr-graph replay`` does, step by step."""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from pdr_graph.errors import InputError
from pdr_graph.estimation.fixes_alone import follow
from pdr_graph.inputs import Inputs, placed_beacons, read_inputs
from pdr_graph.io.writers import write_summary, write_trajectory
from pdr_graph.online.contract import Live, Pose, trajectory_of
from pdr_graph.online.events import Event, events_of
from pdr_graph.online.journal import Journal, fingerprint
from pdr_graph.online.latency import Latency
from pdr_graph.pipeline import Stages, check_rate, summarize, unscored, with_truth, write_report, write_results
from pdr_graph.types import Estimate, Headings, Trajectory


def replay_recording(
    recording: Path,
    out: Path,
    plan: Path | None = None,
    fixes: Path | None = None,
    walker: Path | None = None,
    use_recorded_fixes: bool = True,
    rate: float | None = None,
    floor_label: str | None = None,
    beacons: Path | None = None,
    lag: float | None = 60.0,
    journal: Path | None = None,
    truth: Path | None = None,
    kind: Any = None,
) -> tuple[str, ...]:
    """Push a recording through a navigator; write its poses, latency, smoothed trajectory, picture, report and
    summary.

    Arguments as of ``pdr-graph replay``; lag: None keeps all of the walk open; truth: only drawn and scored; kind: of
    navigator, by default ``Navigator``. Returns what could not be estimated or written. Raises InputError if an input
    cannot be used.
    """
    check_rate(rate)
    stage, latency = Stages(), Latency()
    files = {"map": plan, "fixes": fixes, "beacons": beacons}
    with stage("reading"):
        given = read_inputs(recording, plan, fixes, walker, use_recorded_fixes, beacons=beacons)
        given = with_truth(given, truth)
        events = list(events_of(replace(given.walk, fixes=given.fixes)))
    out.mkdir(parents=True, exist_ok=True)
    settings = {"walker": given.walker.describe(), "recorded_fixes": use_recorded_fixes, "lag": lag}
    settings |= {"floor": floor_label}
    with stage("opening"):
        make, restored = _makers(kind or _navigator(), given, lag, floor_label)
        told = {"recording": given.walk.source, "events": len(events)} | _prints(files) | settings
        nav = make() if journal is None else Journal.open(journal, make, restored, told)
    gc.freeze()  # what is there by now stays: a collection that looks at all of it takes 30 ms of some step
    with nav if isinstance(nav, Journal) else nullcontext():
        done = nav.count if isinstance(nav, Journal) else 0
        began = time.perf_counter()
        causal = walked(nav, _shown(events[done:]), latency)
        stage.seconds["replay"] = round(time.perf_counter() - began, 4)
        with stage("finish"):
            estimate, missing = _finished(nav, given)
        steps, ailments = nav.steps, nav.status.ailments
    with stage("write"):
        missing += write_results(out, given, estimate, rate)
        write_trajectory(out / "causal.csv", causal, given.walk.clock_origin)
        write_summary(out / "latency.json", latency.describe())

    resumed = (f"{done} events were in the journal: causal.csv and latency.json begin after them",) if done else ()
    files |= {"journal": journal, "truth": truth}
    settings |= {name: str(path) if path else None for name, path in files.items()}
    summary = summarize(given.walk, None, Headings.none(), given.building, None, given.frame, estimate)
    summary |= {"steps": steps, "seconds": stage.seconds, "settings": settings | {"rate": rate}}
    summary |= {"missing": list(missing), "warnings": [*given.notes, *resumed, *estimate.warnings, *ailments]}
    with stage("report"):
        missing += write_report(out, given, estimate, summary, causal=lambda: {"live": causal})
        missing += unscored(truth, given, estimate)
    write_summary(out / "summary.json", summary | {"missing": list(missing)})
    return missing


def walked(nav: Live, events: Iterable[Event], latency: Latency) -> Trajectory:
    """Push them, and keep the pose at once: the first there is, that when each step is known, and the last."""
    poses, most = list[Pose](), nav.steps
    for event in events:
        latency.push(nav.push, event)
        pose = None
        if nav.steps > most:  # more than ever: the last ones may have been taken back
            most = nav.steps
            pose = latency.step(lambda: nav.pose)
        elif not poses:
            pose = nav.pose
        if pose is not None:
            poses.append(pose)
            latency.look(pose.time)
    last = nav.pose
    if last is not None and poses and last.time > poses[-1].time:
        poses.append(last)
    return trajectory_of(poses)


def _makers(kind: Any, given: Inputs, lag: float | None, floor_label: str | None) -> tuple[Any, Any]:
    """What makes a navigator at the start of a walk, and what makes one of a snapshot."""
    beacons = placed_beacons(given.walk, given.frame, given.notes)
    options = {"floor": given.building, "lag": lag, "walker": given.walker, "frame": given.frame}
    options |= {"beacons": beacons, "begins": floor_label}
    return partial(kind, **options), partial(kind.restored, **options)


def _prints(files: dict[str, Path | None]) -> dict[str, str]:
    return {name: fingerprint(path) for name, path in files.items() if path}


def _navigator() -> Any:
    from pdr_graph.online.navigator import Navigator

    return Navigator


def _finished(nav: Live, given: Inputs) -> tuple[Estimate, tuple[str, ...]]:
    """The smoothed walk, and what of it could not be had; the fixes alone where there are no steps."""
    estimate = nav.finish()
    if len(estimate.trajectory):
        return estimate, () if estimate.converged else ("a settled optimum",)
    if not len(given.fixes):
        raise InputError(given.walk.source, "", "neither steps nor fixes", "accelerometer samples of a second or more")
    return follow(given.fixes), ("steps: none could be had, so that this is the fixes alone, smoothed",)


def _shown(events: Sequence[Event]) -> Iterable[Event]:
    """The events, with a progress bar on a terminal."""
    if not sys.stderr.isatty():
        return events
    from rich.console import Console
    from rich.progress import track

    return track(events, "replay", console=Console(stderr=True))
