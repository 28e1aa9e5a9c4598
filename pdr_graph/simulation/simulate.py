"""A walk from its scenario: who walks, how the body moves, what the phone feels, what it logs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from pdr_graph.errors import expect
from pdr_graph.frames import Frame, earth_field, enu
from pdr_graph.geometry import compose, interpolate, unit, wrap_angle
from pdr_graph.inertial.attitude import Attitude
from pdr_graph.simulation import sensors
from pdr_graph.simulation.body import Body, move
from pdr_graph.simulation.carrying import Motion, carry
from pdr_graph.simulation.pedestrian import Walker
from pdr_graph.simulation.scenario import GivenFixes, Scenario
from pdr_graph.simulation.sensors import BLUETOOTH, WIFI, SatelliteFixes, heard, satellites
from pdr_graph.types import Fixes, Recording, Sightings, Signal, Trajectory

WILD = 8.0  # [σ] by which a wild position is off
SLOWEST = 100.0  # [Hz] at which the movement is made, however slowly the phone samples it


@dataclass(frozen=True)
class Simulation:
    """A walk with its truth. All times are seconds from the start.

    signals: by sensor; gnss: in the metric frame; given: positions that somebody knows.
    """

    scenario: Scenario
    frame: Frame
    walker: Walker
    body: Body
    motion: Motion
    signals: dict[str, Signal]
    gnss: SatelliteFixes | None
    bluetooth: Sightings | None
    wifi: Sightings | None
    given: Fixes | None

    @property
    def truth(self) -> Trajectory:
        """Where the walker was at each sample of the movement, and which way they went."""
        body = self.body
        return Trajectory(
            time=body.time,
            position=body.position,
            heading=np.asarray(wrap_angle(body.heading)),
            floor=tuple(np.array(body.floors, dtype=object)[body.floor]),
        )

    def world_of(self, attitude: Attitude) -> Rotation:
        """From the true world to the attitude's: n rotations, about the vertical where the attitude is level."""
        time = np.clip(attitude.time, 0, self.motion.time[-1])
        truth = Slerp(self.motion.time, self.motion.R_world_device)(time)
        return compose(attitude.R_world_device, truth.inv())

    def recording(self, *sensors: str) -> Recording:
        """What some of its sensors logged, as if read from a file; without a name all of them."""
        signals = {name: self.signals[name] for name in sensors or self.signals}
        return Recording(
            source="simulated",
            clock_origin=0.0,
            epoch=None,
            accelerometer=signals.get("accelerometer"),
            gyroscope=signals.get("gyroscope"),
            magnetometer=signals.get("magnetometer"),
            barometer=signals.get("barometer"),
        )


def simulate(scenario: Scenario) -> Simulation:
    """The same scenario is the same walk, sample by sample: each part draws from a stream of its own.

    What steel and walls do to the magnetic field and to radio is the place's, and the same for every walk there.
    """
    expect("simulate, scenario", scenario, Scenario, instead='Scenario.load("arcade")')
    streams = np.random.default_rng(scenario.seed).spawn(10)
    frame = next((plan.frame for plan in scenario.plans.values()), enu(*scenario.place[::-1]))
    place = np.random.default_rng(np.round((frame.to_lonlat(np.zeros((1, 2)))[0] + 360) * 1e6).astype(int))
    phone = scenario.phone

    # Who walks, and how the body moves
    walker = Walker.drawn(streams[0], scenario.walker.height or None, scenario.walker.sex or None)
    rate = phone.rate * np.ceil(SLOWEST / phone.rate)
    clearances = {label: (lambda at, plan=plan: plan.distance.at(at)[0]) for label, plan in scenario.plans.items()}
    route = scenario.route
    body = move(
        walker, route.stretches, route.start, route.heading, route.floor, phone.hold, rate, streams[1], clearances
    )

    # What the phone feels, and what it logs
    motion = carry(body, walker, streams[2])
    signals = sensors.imu(motion, phone.clock, streams[3])
    lon, lat = frame.to_lonlat(np.zeros((1, 2)))[0]
    field = sensors.MagneticField.drawn(place, earth_field(lat, lon, scenario.start).vector, phone.disturbance)
    signals["magnetometer"] = sensors.magnetometer(motion, body.position, field, phone.clock, streams[4])
    slow_clock = sensors.Clock(rate=phone.barometer_rate)
    signals["barometer"] = sensors.barometer(motion, phone.altitude, slow_clock, streams[5])

    # What its radios hear
    return Simulation(
        scenario=scenario,
        frame=frame,
        walker=walker,
        body=body,
        motion=motion,
        signals={name: signals[name] for name in phone.sensors},
        gnss=satellites(body, scenario.gnss, streams[6]) if scenario.gnss else None,
        bluetooth=heard(body, scenario.beacons, BLUETOOTH, streams[8], place) if scenario.beacons else None,
        wifi=heard(body, scenario.access_points, WIFI, streams[9], place) if scenario.access_points else None,
        given=_known_positions(body, scenario.given, streams[7]) if scenario.given else None,
    )


def _known_positions(body: Body, given: GivenFixes, random: np.random.Generator) -> Fixes:
    time = np.arange(0.0, body.time[-1], given.period)
    at = interpolate(time, body.time, body.position)
    place = at + random.normal(0, given.sigma, at.shape)
    wild = random.random(len(time)) < given.wild
    place[wild] += WILD * given.sigma * unit(random.uniform(-np.pi, np.pi, int(wild.sum())))
    row = np.clip(np.searchsorted(body.time, time), 0, len(body.time) - 1)
    labels = tuple(body.floors[n] for n in body.floor[row])
    return Fixes(time, place, np.full(len(time), given.sigma), labels)
