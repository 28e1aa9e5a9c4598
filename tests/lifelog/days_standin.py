"""Recordings of a moment and a quick way to make days of them, for tests of what happens to days."""

import math
import os
import resource
import signal
import time as clock
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial

import numpy as np
from made_tracks import geolife

from pdr_graph.apps.lifelog import workers
from pdr_graph.apps.lifelog.day import STANDING, WALKING, Outing, Segment, Stay
from pdr_graph.apps.lifelog.day import Day as OneDay
from pdr_graph.apps.lifelog.observation import observe
from pdr_graph.gait.walker import Profile
from pdr_graph.types import DAY_LENGTH, Trajectory

FIRST = datetime(2024, 5, 1, 22, 30, tzinfo=UTC).timestamp()  # [s] Unix time of the first recording

LIMIT = 60.0  # [s] of a day that hangs

PLACE = 52.5, 13.4  # latitude and longitude of all recordings [deg]


def recording(path, day=0.0, points=4, seed=0):
    """Write a GeoLife file of a few points, ten seconds apart, `day` days after FIRST."""
    time = FIRST + day * DAY_LENGTH + 10.0 * np.arange(points)
    return geolife(path, time, np.array(PLACE[::-1]) + np.random.default_rng(seed).normal(0, 1e-4, (points, 2)))


def recordings(folder, people=3, days=5):
    """Write a recording of each person on each day; returns the paths by person."""
    return {
        f"person{p}": [recording(folder / f"{p}-{d}.plt", d, seed=100 * p + d) for d in range(days)]
        for p in range(people)
    }


def outing(name, observation, scale=1.0):
    """An outing at the fixes of an observation, scaled."""
    fixes = observation.fixes
    n = len(fixes)
    heading = np.linspace(0, 1, n)
    heading[0] = np.nan
    track = Trajectory(fixes.time, fixes.position * scale, heading, ("1",) * n, np.tile(np.eye(3) * scale, (n, 1, 1)))
    stay = Stay(0.0, 10.0, True, track.position[0], np.eye(2), np.nan, "1", (("a shop", 0.75), ("another", 0.2)))
    segments = (Segment(WALKING, 0.0, 10.0, 7.0), Segment(STANDING, 10.0, float(fixes.time[-1]), 0.0))
    return Outing(
        recordings=(name,),
        source=observation.source,
        epoch=observation.epoch,
        frame=observation.frame,
        plan=observation.plan,
        trajectory=track,
        segments=segments,
        stays=(stay, replace(stay, passing=False, heading=0.5, facing=())),
        steps=n,
        notes=("a note",),
    )


def reconstruct(person, date, observations, profile, ways=None):
    """A day in which every number depends on all its inputs, also on the days before."""
    scale = 1.0 if profile is None else 1.0 + profile.E_length
    outings = tuple(outing(name, observation, scale) for name, observation in observations.items())
    total = float(sum(o.trajectory.position.sum() for o in outings))
    before = 0.0 if profile is None else profile.E_length
    return OneDay(
        person, date, outings, Profile(0.9 * before + 1e-3 * math.sin(total), 0.01, 0.02, np.eye(3), 0.5, np.nan)
    )


def failing_on(*dates):
    """`reconstruct` that fails on some dates."""
    return partial(_failing, dates)


def _failing(dates, person, date, observations, profile, ways=None):
    if date in dates:
        raise ZeroDivisionError(f"no day\nlike {date}")
    return reconstruct(person, date, observations, profile)


def dying_or_hanging(person, date, observations, profile, ways=None):
    """`reconstruct` that ends the process on one day of one person, as a crash in a library would.

    On a day of another it hangs, half a second before its time limit of LIMIT.
    """
    if (person, date) == ("person1", "2024-05-02"):
        os._exit(11)
    if (person, date) == ("person2", "2024-05-02"):
        workers._set_deadline(0.5)
        clock.sleep(3600)
    return reconstruct(person, date, observations, profile)


def freezing(file, person, date, observations, profile, ways=None):
    """`reconstruct` that makes a file and stops its process on a day, as a disk that does not answer would."""
    if (person, date) == ("person1", "2024-05-02"):
        file.touch()
        os.kill(os.getpid(), signal.SIGSTOP)
    return reconstruct(person, date, observations, profile)


def counting(folder, person, date, observations, profile, ways=None):
    """`reconstruct` that appends a line to a file per day."""
    with (folder / f"{person} {date}").open("a") as file:
        file.write("made\n")
    return reconstruct(person, date, observations, profile)


def slow(person, date, observations, profile, ways=None):
    """`reconstruct` that takes long enough to be interrupted."""
    clock.sleep(0.02)
    return reconstruct(person, date, observations, profile)


def waiting(folder, after, end, *day):
    """`reconstruct` that counts in a folder and waits after so many days, until the file `end` is there."""
    while len(os.listdir(folder)) >= after and not end.exists():
        clock.sleep(0.02)
    return counting(folder, *day)


def filling(person, date, observations, profile, ways=None):
    """`reconstruct` in a process that can write only 100 bytes per file from then on."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
    return reconstruct(person, date, observations, profile)


def dying_of(name, recording, options):
    """`observe` that ends the process on one recording."""
    if recording.name == name:
        os._exit(11)
    return observe(recording, options)


def scheduler(port):
    """Run a scheduler of Dask on a port of this machine, the whole of a process."""
    from distributed.cli.dask_scheduler import main

    _hush()
    main(["--port", port, "--host", "127.0.0.1", "--no-dashboard"])


def worker(address):
    """Run the worker of a scheduler, which nothing restarts, the whole of a process."""
    from distributed.cli.dask_worker import main

    _hush()
    main([address, "--no-dashboard", "--no-nanny", "--nthreads", "1"])


def _hush():
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
