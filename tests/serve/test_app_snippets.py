"""docs/app.md and the example app: each field that they post is one that the server reads, in its units and signs.

The expressions of the Kotlin and Swift snippets are evaluated here with what Android and CoreMotion measure on a walk;
the messages are posted, and the walk is that of the same samples posted directly.
"""

import json
import re
from types import SimpleNamespace

import numpy as np
import pytest
import simulated
from plans import ROOT
from streamed_walks import bodies, local_server, until, used

from pdr_graph.apps.serve.application import WEB
from pdr_graph.apps.serve.sensor_messages import USED_COLUMNS, Message, Sample
from pdr_graph.io.validation import RADIUS_68
from pdr_graph.lab.simulation.streaming import message
from pdr_graph.types import STANDARD_GRAVITY

PAGE = (ROOT / "docs" / "app.md").read_text(encoding="utf-8")
KOTLIN, SWIFT = (re.search(rf"```{name}\n(.*?)```", PAGE, re.DOTALL)[1] for name in ("kotlin", "swift"))
BROWSER = (WEB / "app.html").read_text(encoding="utf-8")
LONGEST = 48  # lines
FIELDS = {
    "Kotlin": r'"(\w+)" to (if \(\w+\.\w+\(\)\) \S+ else -\w+|[^,)\n]+)',
    "Swift": r'"(\w+)": (-9\.80665 \* \(.*?\)|[^,\]]+)',
}
WALK = simulated.walk_along(np.array([[0.0, 0.0], [16.0, 0.0]]), seed=2)
RECORDING = simulated.with_receiver(WALK, every=200)
KINDS = {"TYPE_ACCELEROMETER": "accelerometer", "TYPE_GYROSCOPE": "gyroscope", "TYPE_MAGNETIC_FIELD": "magnetometer"}


def puts(text, fields):
    """The expression of each value by the name of its sensor, from the statements `put(…)` of a snippet."""
    found = {}
    for part in re.findall(r"put\((.*?)(?=\n    \}|\n        \}|put\(|override|private|$)", text, re.DOTALL):
        name = re.match(r'"(\w+)"', part)
        values = dict(re.findall(fields, part))
        if name and values:
            found[name[1]] = values
        elif part.startswith("names.getValue"):
            found["names"] = values
    return found


def of_android():
    """The expressions of the Kotlin snippet, by sensor."""
    found = puts(KOTLIN, FIELDS["Kotlin"])
    axes = found.pop("names")
    return found | {name: axes for _, name in re.findall(r'Sensor\.(TYPE_\w+) to "(\w+)"', KOTLIN)}


def value(expression, **objects):
    """The value of an arithmetic expression of Kotlin or Swift."""
    expression = re.sub(r"if \((.*)\) (\S+) else (\S+)", r"(\2 if \1 else \3)", expression)
    return eval(re.sub(r"\b1f\b", "1.0", expression), {"__builtins__": {}}, objects)


def vector(values):
    return SimpleNamespace(**dict(zip("xyz", map(float, values), strict=True)))


def sample(name, time, values):
    return {"name": name, "time": round(1e9 * (RECORDING.epoch + time)), "values": values}


def android_samples():
    """What the Kotlin snippet puts: Android's sensors are the recording's."""
    for sensor, name in (("accelerometer", "accelerometeruncalibrated"), ("gyroscope", "gyroscope")):
        signal = getattr(RECORDING, sensor)
        for time, values in zip(signal.time.tolist(), signal.values.tolist(), strict=True):
            event = SimpleNamespace(values=values)
            yield sample(name, time, {key: value(text, e=event) for key, text in of_android()[name].items()})
    for time, (lon, lat), sigma in fixes():
        unknown = {"hasSpeed": lambda: False, "hasBearing": lambda: False, "speed": 0.0, "bearing": 0.0}
        place = SimpleNamespace(latitude=lat, longitude=lon, accuracy=RADIUS_68 * sigma, **unknown)
        yield sample("location", time, {key: value(text, l=place) for key, text in of_android()["location"].items()})


def ios_samples():
    """What the Swift snippet puts: CoreMotion parts g and the rest of the specific force, both reversed."""
    texts = puts(SWIFT, FIELDS["Swift"])
    gravity = -WALK.up
    user = -RECORDING.accelerometer.values / STANDARD_GRAVITY - gravity
    rows = zip(WALK.time.tolist(), user, gravity, RECORDING.gyroscope.values, strict=True)
    for time, *measured in rows:
        objects = dict(zip("agw", map(vector, measured), strict=True))
        for name in ("accelerometeruncalibrated", "gyroscope"):
            yield sample(name, time, {key: value(text, **objects) for key, text in texts[name].items()})
    for time, (lon, lat), sigma in fixes():
        coordinate = SimpleNamespace(latitude=lat, longitude=lon)
        place = SimpleNamespace(coordinate=coordinate, horizontalAccuracy=RADIUS_68 * sigma, speed=-1.0, course=-1.0)
        yield sample("location", time, {key: value(text, l=place) for key, text in texts["location"].items()})


def fixes():
    return zip(RECORDING.fixes.time.tolist(), RECORDING.fixes.position.tolist(), RECORDING.fixes.sigma, strict=True)


SNIPPETS = {
    "Kotlin": (KOTLIN, of_android, android_samples),
    "Swift": (SWIFT, lambda: puts(SWIFT, FIELDS["Swift"]), ios_samples),
}


@pytest.mark.parametrize("language", SNIPPETS)
def test_each_field_of_a_snippet_is_one_that_the_server_reads(language):
    text, expressions, _ = SNIPPETS[language]
    assert len(text.splitlines()) <= LONGEST
    sensors = expressions()
    assert set(sensors) == {"accelerometeruncalibrated", "gyroscope", "magnetometer", "location"}
    for name, values in sensors.items():
        assert set(values) <= set(USED_COLUMNS[name]), name
        assert set(USED_COLUMNS[name]) - set(values) <= {"speedAccuracy", "bearingAccuracy"}, name
    keys = set(re.findall(r'"(\w+)"(?: to |: )', text))
    of_message = set(Message.__struct_fields__) | set(Sample.__struct_fields__) - {"accuracy"}
    assert keys - {key for values in sensors.values() for key in values} == of_message
    assert "platform=android" in PAGE


def test_the_sensors_of_the_kotlin_snippet_are_androids():
    named = dict(re.findall(r'Sensor\.(TYPE_\w+) to "(\w+)"', KOTLIN))
    assert {kind: name.removesuffix("uncalibrated") for kind, name in named.items()} == KINDS


def test_each_field_of_the_browsers_page_is_one_that_the_server_reads():
    found = {}
    for name, values in re.findall(r'\bput\("(\w+)", [^{]*\{(.*?)\}', BROWSER, re.DOTALL):
        found[name] = set(re.findall(r"(\w+): ", values))
    assert set(found) == {"accelerometeruncalibrated", "gyroscope", "magnetometer", "location"}
    assert all(values <= set(USED_COLUMNS[name]) for name, values in found.items())


def test_the_table_of_the_page_names_what_the_server_reads():
    rows = dict(re.findall(r"^\| `(\w+)` \| (.*?) \|", PAGE, re.MULTILINE)[1:])
    for name, text in rows.items():
        listed = set(re.findall(r"`(\w+)`", text))
        assert listed <= set(USED_COLUMNS.get(name, ("id", "rssi"))), name
    assert {"accelerometeruncalibrated", "gyroscope", "magnetometer", "barometer", "location", "bluetooth"} == set(rows)


@pytest.mark.parametrize("language", SNIPPETS)
def test_the_values_of_a_snippet_are_in_the_units_signs_and_axes_of_the_server(language):
    _, expressions, samples = SNIPPETS[language]
    found = {}
    for each in samples():
        found.setdefault(each["name"], []).append([each["values"][key] for key in USED_COLUMNS[each["name"]][:3]])
    assert np.allclose(found["accelerometeruncalibrated"], RECORDING.accelerometer.values)
    assert np.allclose(found["gyroscope"], RECORDING.gyroscope.values)
    radius = RADIUS_68 * RECORDING.fixes.sigma
    assert np.allclose(found["location"], np.column_stack([RECORDING.fixes.position[:, ::-1], radius]), atol=1e-12)
    field = {"e": SimpleNamespace(values=[1.0, 2.0, 3.0]), "b": vector((1, 2, 3))}  # µT on both
    measured = expressions()["magnetometer"]
    assert {axis: value(text, **field) for axis, text in measured.items()} == {"x": 1.0, "y": 2.0, "z": 3.0}


@pytest.mark.parametrize("language", SNIPPETS)
def test_the_messages_of_a_snippet_are_the_walk(language, tmp_path):
    _, _, samples = SNIPPETS[language]
    seconds = dict[int, list[dict]]()
    for each in sorted(samples(), key=lambda each: each["time"]):
        seconds.setdefault(each["time"] // 10**9, []).append(each)
    posted = [message("snippet", n, payload) for n, payload in enumerate(seconds.values())]
    direct = bodies(RECORDING, "direct")
    with local_server(tmp_path) as client:
        for body in (*posted, *direct):
            assert client.post("/sensorlogger?platform=android", content=body).status_code == 200
        pose, expected = (until(lambda id_=id_: used(client, len(direct), id_)) for id_ in ("snippet", "direct"))
    assert pose["steps"] == expected["steps"] > 15
    assert np.hypot(pose["x"] - expected["x"], pose["y"] - expected["y"]) < 0.02
    assert pose["issues"] == expected["issues"]
    assert json.dumps(pose["ignored"]) == "{}"
