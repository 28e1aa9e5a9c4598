"""A stand-in for phyphox's remote access: the documented calls, each connection closed after its answer."""

import json
import threading
import urllib.parse
from contextlib import contextmanager

from stand_in_server import QuietHandler, served

BUFFERS = {  # sensor of the experiment: its outputs and their buffers
    "accelerometer": {"x": "accX", "y": "accY", "z": "accZ", "t": "acc_time"},
    "gyroscope": {"x": "gyrX", "y": "gyrY", "z": "gyrZ", "t": "gyr_time"},
    "location": {"lat": "locLat", "lon": "locLon", "z": "locZ", "accuracy": "locAccuracy", "t": "loc_time"},
    "light": {"x": "light", "t": "light_time"},
}
NUDGE = 1e-7  # relative: thresholds are moved up, since the values have eight digits


class Phone:
    """The state of the app. faults: what the next answers do instead: "reset", "half" or a status."""

    def __init__(self):
        self.session, self.measuring, self.events, self.asked, self.faults = "ab12cd", False, [], [], []
        self.buffers = {name: [] for outputs in BUFFERS.values() for name in outputs.values()}
        self.lock = threading.Lock()

    def start(self, experiment, system, event="START"):
        self.measuring = event == "START"
        self.events.append({"event": event, "experimentTime": experiment, "systemTime": system})

    def pause(self, experiment, system):
        self.start(experiment, system, "PAUSE")

    def clear(self):
        """As the button does: data and times begin again, the session stays."""
        self.measuring, self.events = False, []
        for values in self.buffers.values():
            values.clear()

    def record(self, sensor, time, *values):
        names = BUFFERS[sensor]
        outputs = [names[key] for key in names if key != "t"]
        with self.lock:
            for name, value in zip([names["t"], *outputs], [time, *values], strict=True):
                self.buffers[name].append(value)

    def answer(self, path, parameters):
        if path == "/config":
            inputs = [
                {"source": sensor, "outputs": [{key: name} for key, name in outputs.items()]}
                for sensor, outputs in BUFFERS.items()
            ]
            return {"crc32": "1f", "title": "Walk", "inputs": inputs, "export": []}
        if path == "/meta":
            return {"deviceBrand": "Fairphone", "deviceModel": "5", "version": "1.2.1", "sensors": {}}
        if path == "/time":
            return self.events
        if path == "/get":
            status = {"session": self.session, "measuring": self.measuring, "timedRun": False, "countDown": 0}
            with self.lock:
                return {"buffer": {name: self._part(name, how) for name, how in parameters}, "status": status}
        return None

    def _part(self, name, how):
        values = self.buffers[name]
        if not how:
            return {"size": 0, "updateMode": "single", "buffer": [_digits(values[-1]) if values else None]}
        threshold, _, reference = how.partition("|")
        least = float(threshold) + abs(float(threshold)) * NUDGE
        by = self.buffers[reference or name]
        kept = [_digits(value) for value, at in zip(values, by, strict=False) if at > least]
        return {"size": 0, "updateMode": "partial", "buffer": kept}


def _digits(value):
    return None if value is None or value != value else float(f"{value:.7e}")


@contextmanager
def serving(phone):
    """Serve a phone; yields its address."""

    class Handler(QuietHandler):
        protocol_version = "HTTP/1.1"  # as if it kept connections

        def do_GET(self):
            phone.asked.append((self.path, self.headers.get("Connection")))
            fault = phone.faults.pop(0) if phone.faults else None
            self.close_connection = True  # but it drops them
            if fault == "reset":
                return None
            path, _, text = self.path.partition("?")
            parameters = urllib.parse.parse_qsl(text, keep_blank_values=True)
            content = phone.answer(path, parameters)
            status = fault if isinstance(fault, int) else 404 if content is None else 200
            body = json.dumps(content).encode()
            self.send_response(status)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body[: len(body) // 2] if fault == "half" else body)
            return None

    with served(Handler) as server:
        yield f"http://127.0.0.1:{server.server_port}"
