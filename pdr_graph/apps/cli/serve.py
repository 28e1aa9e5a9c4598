"""``pdr-graph serve``."""

from __future__ import annotations

import secrets
import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from cyclopts.validators import Number

from pdr_graph.apps.cli.parameters import HYPHEN, Count, only
from pdr_graph.apps.cli.terminal import echo
from pdr_graph.errors import InputError, install
from pdr_graph.options import Options

Port = Annotated[Count, Parameter(validator=Number(gte=0, lte=65535), help="0: any free one.")]
LOOPBACK = "127.0.0.1"
STUDY = "study"  # folder of the uploads that wait


def serve(
    *,
    options: Annotated[
        Options, only("plan", "walker", "beacons", "radio_map", "paths", "floor", "lag", "settings")
    ] = Options(),
    store: Path | None = None,
    port: Port = 8080,
    host: str = LOOPBACK,
    token: Annotated[str | None, HYPHEN] = None,
    user: tuple[str, ...] = (),
    out: Path = Path("pdr-graph-serve"),
    workers: Annotated[Count, Parameter(validator=Number(gte=0, lte=64))] = 1,
    certificate: Path | None = None,
    tiles: str | None = None,
    phyphox: tuple[str, ...] = (),
    mqtt: str | None = None,
    mqtt_topic: tuple[str, ...] = ("sensor-logger",),
    home_assistant: str | None = None,
    heard_as: tuple[str, ...] = (),
    motion: tuple[str, ...] = (),
    study: tuple[str, ...] = (),
    alert: tuple[str, ...] = (),
) -> None:
    """Show live phones on a map.

    Phones send their sensors with the app Sensor Logger or by their browser, on the page /app; or positions with
    OwnTracks, Overland or Traccar Client.

    pdr-graph serve                                    only from this machine
    pdr-graph serve --host 0.0.0.0 --map plan.geojson  phones in the network, with a token
    pdr-graph serve --host 0.0.0.0 --certificate c.pem the same by HTTPS, as browsers ask for sensors

    Args:
        store: A lifelog, to which finished walks are added.
        host: 0.0.0.0 for phones in the network; the default is this machine only.
        token: Secret of the owner; default: created on the first start with another host.
        user: Another user, with a token of their own; repeatable.
        out: Folder of sessions and tokens, for its owner alone.
        workers: Estimating processes, up to 64; 0: a thread.
        certificate: PEM file with certificate and private key, for HTTPS; default: HTTP.
        tiles: Tile server for the page's map, https://host/{z}/{x}/{y}.png; default: none.
        phyphox: A phone with phyphox's remote access, http://192.168.0.12:8080; repeatable.
        mqtt: Broker that phones publish to: mqtt, mqtts, ws or wss://USER@HOST:PORT.
        mqtt_topic: Topic of --mqtt, of Sensor Logger or OwnTracks (owntracks/+/+); repeatable.
        home_assistant: Broker of Home Assistant, to which phones are announced: as --mqtt.
        heard_as: PHONE=DEVICE, a phone of --home-assistant and its Bluetooth device, as ESPresense or bermuda names it;
            repeatable.
        motion: SENSOR=ROOM, a binary_sensor of Home Assistant and the room of --map that it sees; repeatable.
        study: Sensor Logger study whose uploads are reported; any: all; repeatable.
        alert: ROOM=URL, an address that gets a POST when a phone enters a named area of --map; repeatable.
    """
    try:
        from pdr_graph.apps.serve import serving
    except ImportError as error:
        raise InputError("serve", error.name or "", "no such package", install("serve")) from None
    from pdr_graph.apps.serve.access import LOCAL_HOSTS, load_tokens
    from pdr_graph.apps.serve.application import checked_tiles
    from pdr_graph.apps.serve.home_assistant import Alert, motion_of
    from pdr_graph.apps.serve.pulling import PhyphoxPhone, Sources, broker_of
    from pdr_graph.apps.serve.receivers import receivers_of
    from pdr_graph.apps.serve.study import StudyReports

    if certificate is not None:
        serving.check_certificate(certificate)
    building, placed = serving.read_inputs(options)
    out.mkdir(parents=True, exist_ok=True, mode=0o700)
    file = out / serving.TOKENS
    secured = host not in LOCAL_HOSTS or token is not None or bool(user) or file.exists()
    tokens = load_tokens(file, user, token) if secured else {}
    reports = StudyReports(out / STUDY, study, options.plan, serving.say) if study else None
    for url in phyphox:
        PhyphoxPhone(url)  # refuses what is no address
    home = broker_of(home_assistant, (), "--home-assistant") if home_assistant else None
    receivers = receivers_of(home, heard_as, placed.name if placed else ()) if heard_as else None
    pulled = broker_of(mqtt, mqtt_topic) if mqtt else None
    alerts = tuple(Alert.of(text, building) for text in alert)
    sources = Sources(phyphox, pulled, reports, home, receivers, alerts, motion_of(home, motion, building))
    server = serving.Settings(out, options, store, workers, tokens, checked_tiles(tiles), sources=sources)
    app = serving.build(server, building)
    scheme = "https" if certificate else "http"

    def ready(port: int) -> None:
        _print_addresses(serving.addresses(host, port, scheme), tokens, file)

    serving.serve(app, host, port, ready, certificate)


LIFELOG_PORT = 8081  # not that of `serve`


def serve_lifelog(store: Path, /, *, port: Port = LIFELOG_PORT, tiles: str | None = None) -> None:
    """Show and correct days in the browser, on this machine alone.

    The address that is printed has a token that is valid until Ctrl-C.

    pdr-graph lifelog serve days.db

    Args:
        store: The lifelog.
        tiles: Tile server for the page's map, https://host/{z}/{x}/{y}.png; default: none.
    """
    try:
        from pdr_graph.apps.serve import application, diary_page, serving
    except ImportError as error:
        raise InputError("serve", error.name or "", "no such package", install("serve")) from None
    from pdr_graph.apps.lifelog.store import Store

    with Store(store, reads=True):
        pass  # refuses what is no lifelog
    token = secrets.token_urlsafe(24)
    app = diary_page.application(store, token, application.checked_tiles(tiles))
    serving.serve(app, LOOPBACK, port, lambda port: echo(f"http://{LOOPBACK}:{port}/?token={token}   Ctrl-C ends"))


def _print_addresses(addresses: list[str], tokens: dict[str, str], file: Path) -> None:
    """Print the page of each user and the address for the phone, as text and as a QR code on a terminal."""
    for name, secret in (tokens or {"": ""}).items():
        query = f"?token={secret}" if secret else ""
        of = f" of {name}" if name else ""
        for address in addresses:
            echo(f"page{of}: {address}/{query}")
        if addresses[0].startswith("https:") or LOOPBACK in addresses[0]:  # else browsers give no sensors
            echo(f"app{of}, for the phone's browser: {addresses[0]}/app{query}")
        push = f"{addresses[0]}/sensorlogger{query}"
        echo(f"Sensor Logger{of}, Settings, Data Streaming, Push URL: {push}")
        if sys.stdout.isatty():
            import segno

            segno.make(push, error="l").terminal(compact=True)
    if tokens:
        echo(f"tokens are in {file}; Ctrl-C ends")
    sys.stdout.flush()
