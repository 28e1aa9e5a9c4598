"""Simulate a walk from a scenario: pedestrian, movement of the body, motion of the phone, measurements."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from pdr_graph.errors import expect
from pdr_graph.frames import Frame, earth_field, enu
from pdr_graph.geometry import compose, interpolate, unit, wrap_angle
from pdr_graph.inertial.attitude import Attitude
from pdr_graph.inertial.units import BY_PLATFORM
from pdr_graph.lab.simulation import sensors
from pdr_graph.lab.simulation.body import Body, Pedestrian, move
from pdr_graph.lab.simulation.carrying import Motion, carry
from pdr_graph.lab.simulation.scenario import Scenario, UserFixes
from pdr_graph.lab.simulation.sensors import BLUETOOTH, WIFI, SatelliteFixes, gnss_fixes, receptions
from pdr_graph.types import Fixes, OneLineRepr, Recording, Sightings, Signal, Trajectory


@dataclass(frozen=True)
class Simulation(OneLineRepr):
    """A simulated walk with its truth. All times are seconds from the start.

    signals: by sensor; gnss: in the metric frame; user_fixes: positions that the user knows.
    """

    scenario: Scenario
    frame: Frame
    walker: Pedestrian
    body: Body
    motion: Motion
    signals: dict[str, Signal]
    gnss: SatelliteFixes | None
    bluetooth: Sightings | None
    wifi: Sightings | None
    user_fixes: Fixes | None

    def _summary(self) -> list[str]:
        return [repr(self.scenario.name), *self.body._summary()]

    @property
    def truth(self) -> Trajectory:
        """True positions and walking directions at each sample of the movement."""
        body = self.body
        return Trajectory(
            time=body.time,
            position=body.position,
            heading=np.asarray(wrap_angle(body.heading)),
            floor=tuple(np.array(body.floors, dtype=object)[body.floor]),
        )

    def world_of(self, attitude: Attitude) -> Rotation:
        """Rotations ``(n,)`` from the true world to that of an attitude; about the vertical for level attitudes."""
        time = np.clip(attitude.time, 0, self.motion.time[-1])
        truth = Slerp(self.motion.time, self.motion.R_world_device)(time)
        return compose(attitude.R_world_device, truth.inv())

    def recording(self, *sensors: str) -> Recording:
        """The measurements of some sensors as a recording, as if read from a file; of all sensors by default."""
        signals: dict[str, Any] = {name: self.signals[name] for name in sensors or self.signals}
        return Recording("simulated", clock_origin=0.0, epoch=None, **signals, sign_odds=-BY_PLATFORM)


def simulate(scenario: Scenario) -> Simulation:
    """Simulate the walk of a scenario. Equal scenarios give equal walks, sample by sample.

    Each part of the simulation has its own random generator. The effects of steel on the magnetic field and of walls on
    radio depend on the place only, and are equal for all walks there.
    """
    expect("simulate, scenario", scenario, Scenario, instead='Scenario.load("arcade")')
    return simulate_person(scenario)


def simulate_person(scenario: Scenario, walker: Pedestrian | None = None) -> Simulation:
    """Simulate the walk of a scenario by a walker; None: one drawn at random, of the scenario's height and sex."""
    streams = np.random.default_rng(scenario.seed).spawn(10)
    frame = next((plan.frame for plan in scenario.plans.values()), enu(*scenario.place[::-1]))
    place = np.random.default_rng(np.round((frame.to_lonlat(np.zeros((1, 2)))[0] + 360) * 1e6).astype(int))
    phone = scenario.phone

    # Pedestrian and movement of the body
    walker = walker or Pedestrian.sample(streams[0], scenario.walker.height or None, scenario.walker.sex or None)
    rate = phone.rate * np.ceil(100.0 / phone.rate)  # at least 100 Hz
    clearances = {label: (lambda at, plan=plan: plan.distance.at(at)[0]) for label, plan in scenario.plans.items()}
    route = scenario.route
    body = move(
        walker, route.activities, route.start, route.heading, route.floor, phone.hold, rate, streams[1], clearances
    )

    # Motion of the phone and its sensors
    motion = carry(body, walker, streams[2])
    signals = sensors.imu(motion, phone, streams[3])
    lon, lat = frame.to_lonlat(np.zeros((1, 2)))[0]
    field = sensors.MagneticField.sample(place, earth_field(lat, lon, scenario.start).vector, phone.disturbance)
    signals["magnetometer"] = sensors.magnetometer(motion, body.position, field, phone, streams[4])
    slow_clock = sensors.SampleClock(rate=phone.barometer_rate)
    signals["barometer"] = sensors.barometer(motion, phone.altitude, slow_clock, streams[5])

    # Radios
    return Simulation(
        scenario=scenario,
        frame=frame,
        walker=walker,
        body=body,
        motion=motion,
        signals={name: signals[name] for name in phone.sensors},
        gnss=gnss_fixes(body, scenario.gnss, streams[6]) if scenario.gnss else None,
        bluetooth=receptions(body, scenario.beacons, BLUETOOTH, streams[8], place) if scenario.beacons else None,
        wifi=receptions(body, scenario.access_points, WIFI, streams[9], place) if scenario.access_points else None,
        user_fixes=_user_fixes(body, scenario.user_fixes, streams[7]) if scenario.user_fixes else None,
    )


def _user_fixes(body: Body, errors: UserFixes, random: np.random.Generator) -> Fixes:
    """The positions that the user knows, with their errors; an outlier is off by 8 σ."""
    time = np.arange(0.0, body.time[-1], errors.period)
    at = interpolate(time, body.time, body.position)
    place = at + random.normal(0, errors.sigma, at.shape)
    outlier = random.random(len(time)) < errors.outliers
    place[outlier] += 8.0 * errors.sigma * unit(random.uniform(-np.pi, np.pi, int(outlier.sum())))
    row = np.clip(np.searchsorted(body.time, time), 0, len(body.time) - 1)
    labels = tuple(body.floors[n] for n in body.floor[row])
    return Fixes(time, place, np.full(len(time), errors.sigma), labels)
