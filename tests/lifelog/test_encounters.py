"""Encounters of two people whose phones received each other."""

import numpy as np
import pytest

from pdr_graph.apps.lifelog.multi_day import ENCOUNTER_PERIOD, MIN_RSSI, MIN_SIGMA, CarriedPhone, encounters
from pdr_graph.types import Sightings

PHONES = {"anna's": "anna", "ben's": "ben"}


def heard(time, level=-60.0, who="ben's"):
    time = np.array(time, dtype=float)
    return Sightings(time, (who,) * len(time), np.full(len(time), float(level)))


def anna(sightings, epoch=1000.0):
    return CarriedPhone("anna", epoch, 0.0, 600.0, sightings)


def ben(sightings=None, epoch=900.0):
    return CarriedPhone("ben", epoch, 0.0, 600.0, sightings)


def test_a_reception_closes_both_walks_at_its_time():
    closures = encounters([anna(heard([50.0])), ben()], PHONES)
    assert closures.time == pytest.approx(np.array([[50.0, 150.0]]))
    assert closures.walk.tolist() == [[0, 1]]


def test_either_phone_may_receive_the_other():
    closures = encounters([anna(None), ben(heard([150.0], who="anna's"))], PHONES)
    assert closures.time == pytest.approx(np.array([[150.0, 50.0]]))
    assert closures.walk.tolist() == [[1, 0]]


def test_a_stronger_reception_has_a_smaller_sigma():
    sigma = [encounters([anna(heard([50.0], level)), ben()], PHONES).sigma[0] for level in (-45, -70, -80)]
    assert sigma == sorted(sigma)
    assert sigma[0] == MIN_SIGMA
    assert sigma[2] < 10.0


def test_a_conversation_is_one_encounter_per_period():
    closures = encounters([anna(heard(np.arange(0, 60, 0.2))), ben()], PHONES)
    assert len(closures) == 60 / ENCOUNTER_PERIOD


@pytest.mark.parametrize(
    "sightings",
    [
        heard([50.0], MIN_RSSI - 1),
        heard([50.0], who="a stranger's"),
        heard([50.0], who="anna's"),
        heard([590.0]),  # Ben's walk is over
        heard([-10.0]),
    ],
)
def test_weak_foreign_or_untimely_receptions_are_no_encounters(sightings):
    assert len(encounters([anna(sightings), ben(epoch=800.0)], PHONES)) == 0


def test_walks_of_one_person_have_no_encounters():
    assert len(encounters([anna(heard([50.0], who="anna's")), anna(None, 950.0)], PHONES)) == 0
