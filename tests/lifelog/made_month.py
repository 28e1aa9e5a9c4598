"""A month made by hand: 30 days with silences, and two homes in different time zones.

Ada lives in Berlin, works five kilometres away and shops on Tuesdays and Fridays; on 20 May she flies to Tokyo, where
she has another home and office. Nothing is recorded on two days, nor for two hours of some afternoons, nor at night.
"""

from dataclasses import dataclass, field
from datetime import date, datetime, timedelta
from zoneinfo import ZoneInfo

import numpy as np

from pdr_graph.apps.lifelog.day import STANDING, VEHICLE, WALKING, Day, Outing, Segment, Stay, rows_of
from pdr_graph.apps.lifelog.store import Store
from pdr_graph.frames import enu
from pdr_graph.types import Trajectory

PERIOD = 20.0  # [s] between rows
SPEED = {WALKING: 1.3, VEHICLE: 9.0}  # [m/s]
STEP = 0.7  # [m]
FIRST, DAYS, FLIGHT = date(2024, 5, 1), 30, date(2024, 5, 20)
WITHOUT_DATA = (date(2024, 5, 11), date(2024, 5, 27))
BERLIN = enu(52.52, 13.40), ZoneInfo("Europe/Berlin"), "Office"
TOKYO = enu(35.68, 139.76), ZoneInfo("Asia/Tokyo"), "東京オフィス"
HOME, STATION, OFFICE, SHOP, PARK, AIRPORT = (
    np.array(at)
    for at in ((0.0, 0.0), (400.0, 300.0), (4000.0, 3000.0), (300.0, -200.0), (-900.0, 500.0), (-9000.0, 4000.0))
)


@dataclass
class Diarist:
    """Somebody who goes from place to place; `outing` returns where they went since `start`."""

    frame: object
    start: float
    at: np.ndarray
    time: list = field(default_factory=lambda: [0.0])
    place: list = field(default_factory=list)
    segments: list = field(default_factory=list)
    stays: list = field(default_factory=list)

    def __post_init__(self):
        self.place.append(self.at)

    def go(self, kind, to):
        """Walk or ride to a position ``(2,)`` [m]."""
        far = float(np.hypot(*(to - self.at)))
        share = np.linspace(0, 1, max(int(far / SPEED[kind] / PERIOD), 1) + 1)[1:]
        begin, origin = self.time[-1], self.at
        self.time += (begin + share * far / SPEED[kind]).tolist()
        self.place += list(origin + share[:, None] * (to - origin))
        self.segments.append(Segment(kind, begin, self.time[-1], far))
        self.at = to

    def stay(self, until, name=""):
        """Stay until a Unix time [s]."""
        begin, end = self.time[-1], until - self.start
        if end <= begin:
            return
        self.time += [*np.arange(begin + PERIOD, end, PERIOD).tolist(), end]
        self.place += [self.at] * (len(self.time) - len(self.place))
        facing = ((name, 0.9),) if name else ()
        self.segments.append(Segment(STANDING, begin, end, 0.0))
        self.stays.append(Stay(begin, end, False, self.at, 16.0 * np.eye(2), np.nan, "", facing))

    def outing(self):
        """Everything so far as an outing."""
        n = len(self.time)
        covariance = np.tile(np.diag([16.0, 16.0, 0.1]), (n, 1, 1))
        track = Trajectory(np.array(self.time), np.array(self.place), np.zeros(n), ("",) * n, covariance)
        walked = sum(s.distance for s in self.segments if s.kind == WALKING)
        about = {"recordings": (f"{self.start:.0f}",), "source": "/home/ada/phone.csv", "epoch": self.start}
        return Outing(
            **about,
            frame=self.frame,
            plan="",
            trajectory=track,
            segments=tuple(self.segments),
            stays=tuple(self.stays),
            steps=round(walked / STEP),
        )


def made_month(person="Ada", seed=0, days=DAYS):
    """The days of a person, those without data left out."""
    random = np.random.default_rng(seed)
    dates = [FIRST + timedelta(days=n) for n in range(days)]
    return [_day(person, on, random) for on in dates if on not in WITHOUT_DATA]


def _day(person, on, random):
    frame, zone, office = TOKYO if on > FLIGHT else BERLIN

    def clock(hour, spread=0.15):
        """The Unix time of an hour of the day, somewhat earlier or later."""
        moment = datetime(on.year, on.month, on.day, tzinfo=zone)
        return moment.timestamp() + 3600 * (hour + float(random.normal(0, spread)))

    ada = Diarist(frame, clock(6.5), HOME)
    outings = []
    if on == FLIGHT:
        ada.stay(clock(9.0))
        ada.go(WALKING, STATION)
        ada.go(VEHICLE, AIRPORT)
        ada.stay(clock(12.0), "Airport")
        return Day(person, on.isoformat(), (ada.outing(),))
    if on.weekday() < 5:
        ada.stay(clock(7.75))
        _commute(ada, HOME, OFFICE)
        if on.day % 4 == 0:  # the phone is off for two hours
            ada.stay(clock(13.0), office)
            outings.append(ada.outing())
            ada = Diarist(frame, clock(15.0), OFFICE)
        ada.stay(clock(17.5, 0.3), office)
        _commute(ada, OFFICE, HOME, back=True)
        if on.weekday() in (1, 4):
            ada.go(WALKING, SHOP)
            ada.stay(ada.start + ada.time[-1] + 1500.0, "Supermarket")
        ada.go(WALKING, HOME)
    else:
        ada.stay(clock(10.0, 0.5))
        ada.go(WALKING, PARK)
        ada.stay(ada.start + ada.time[-1] + 3600.0)
        ada.go(WALKING, HOME)
    ada.stay(clock(23.0))
    return Day(person, on.isoformat(), (*outings, ada.outing()))


def _commute(ada, start, end, back=False):
    """Walk to the station, ride, and walk the rest."""
    near, far = (STATION, OFFICE - STATION + HOME)
    for kind, to in ((WALKING, far if back else near), (VEHICLE, near if back else far), (WALKING, end)):
        if not (back and to is end):
            ada.go(kind, to)


def made_store(path, *people, days=DAYS, zone=""):
    """A lifelog with the month of each person."""
    with Store(path, new=True) as log:
        log.put_setting("zone", zone)
        for n, person in enumerate(people or ("Ada",)):
            for day in made_month(person, seed=n, days=days):
                log.put_day(rows_of(day, f"{person} {day.date}", [r for o in day.outings for r in o.recordings]))
    return path
