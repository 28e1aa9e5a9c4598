"""A month made by hand: 30 days with silences, and two homes in different time zones.

Ada lives in Berlin, works five kilometres away and shops on Tuesdays and Fridays; on 20 May she flies to Tokyo, where
she has another home and office. Nothing is recorded on two days, nor for two hours of some afternoons, nor at night.
"""

from dataclasses import dataclass, field, replace
from datetime import date, datetime, timedelta
from zoneinfo import ZoneInfo

import made_days
import numpy as np

from pdr_graph.apps.lifelog.day import STANDING, VEHICLE, WALKING, Day, rows_of
from pdr_graph.apps.lifelog.store import Store
from pdr_graph.frames import enu

PERIOD = 20.0  # [s] between rows
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
    legs: list = field(default_factory=list)
    stays: list = field(default_factory=list)

    def __post_init__(self):
        self.now, self.first = self.start, tuple(self.at)

    def go(self, kind, to):
        """Walk or ride to a position ``(2,)`` [m]."""
        off = to - self.at
        self._spend(kind, float(np.hypot(*off)) / made_days.PACE[kind], np.arctan2(*off[::-1]))
        self.at = to

    def stay(self, until, name=""):
        """Stay until a Unix time [s]."""
        if until > self.now:
            span, facing = (self.now - self.start, until - self.start), [(name, 0.9)] if name else []
            self.stays.append(made_days.stay(*span, self.at, facing, sigma=4.0))
            self._spend(STANDING, until - self.now, 0.0)

    def _spend(self, kind, seconds, heading):
        self.legs.append((kind, seconds, heading))
        self.now += seconds

    def outing(self):
        """Everything so far as an outing."""
        where = {"start": self.first, "sigma": 4.0, "period": PERIOD}
        made = made_days.outing(self.legs, self.start, self.frame, self.stays, **where)
        return replace(made, recordings=(f"{self.start:.0f}",))


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
            ada.stay(ada.now + 1500.0, "Supermarket")
        ada.go(WALKING, HOME)
    else:
        ada.stay(clock(10.0, 0.5))
        ada.go(WALKING, PARK)
        ada.stay(ada.now + 3600.0)
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
