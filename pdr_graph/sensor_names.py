"""Names of the sensors of a phone."""

from __future__ import annotations

from enum import StrEnum

from pdr_graph.errors import one_line


class Sensor(StrEnum):
    """A sensor of a phone; each is equal to its name: ``Sensor.ACCELEROMETER == "accelerometer"``.

    The names are accelerometer, gyroscope, magnetometer, linear_acceleration and barometer.
    ``Sensor(value)`` is the sensor of a name. Raises ValueError for an unknown name, with the known ones.
    """

    ACCELEROMETER = "accelerometer"
    GYROSCOPE = "gyroscope"
    MAGNETOMETER = "magnetometer"
    LINEAR_ACCELERATION = "linear_acceleration"
    BAROMETER = "barometer"

    @classmethod
    def _missing_(cls, value: object) -> Sensor:
        raise ValueError(f"Sensor: {unknown_sensor(value)}")


SENSORS = tuple(sensor.value for sensor in Sensor)


def unknown_sensor(value: object) -> str:
    """What is wrong with a name that no sensor has, and which it may mean: for messages."""
    begin = str(value).lower()[:3]
    close = [name for name in SENSORS if len(begin) == 3 and name.startswith(begin)]
    hint = f" ({close[0]}?)" if close else ""
    return f"found {one_line(repr(value))}{hint}, expected one of {', '.join(SENSORS)}"
