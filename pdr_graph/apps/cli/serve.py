"""``pdr-graph serve``."""

from __future__ import annotations

import secrets
import sys
from pathlib import Path
from typing import Annotated

import typer

from pdr_graph.apps.cli.options import (
    BeaconsPath,
    FloorLabel,
    MapPath,
    PathsPath,
    RadioMapPath,
    Settings,
    WalkerPath,
    lag_seconds,
)
from pdr_graph.apps.cli.terminal import echo
from pdr_graph.errors import InputError, install

LOOPBACK = "127.0.0.1"
STUDY = "study"  # folder of the uploads that wait

StorePath = Annotated[
    Path | None, typer.Option("--store", metavar="STORE", help="A lifelog, to which finished walks are added.")
]
Port = Annotated[int, typer.Option(metavar="N", min=0, max=65535, help="0: any free one.")]
Host = Annotated[
    str, typer.Option(metavar="ADDRESS", help="0.0.0.0 for phones in the network; the default is this machine only.")
]
Token = Annotated[
    str | None,
    typer.Option(metavar="TEXT", help="Secret of the owner; default: created on the first start with another host."),
]
Users = Annotated[
    list[str] | None, typer.Option(metavar="NAME", help="Another user, with a token of their own; repeatable.")
]
Folder = Annotated[
    Path, typer.Option("--out", metavar="DIR", help="Folder of sessions and tokens, for its owner alone.")
]
Workers = Annotated[int, typer.Option(metavar="N", min=0, max=64, help="Estimating processes.")]
Tiles = Annotated[
    str | None,
    typer.Option(metavar="URL", help="Tile server for the page's map, https://host/{z}/{x}/{y}.png; default: none."),
]
Phones = Annotated[
    list[str] | None,
    typer.Option(metavar="URL", help="A phone with phyphox's remote access, http://192.168.0.12:8080; repeatable."),
]
BrokerUrl = Annotated[
    str | None,
    typer.Option(metavar="URL", help="Broker that phones publish to: mqtt, mqtts, ws or wss://USER@HOST:PORT."),
]
Topic = Annotated[str, typer.Option(metavar="TOPIC", help="Topic of --mqtt.")]
HomeAssistant = Annotated[
    str | None,
    typer.Option(metavar="URL", help="Broker of Home Assistant, to which phones are announced: as --mqtt."),
]
HeardAs = Annotated[
    list[str] | None,
    typer.Option(
        metavar="PHONE=DEVICE",
        help="A phone of --home-assistant and its Bluetooth device, as ESPresense or bermuda names it; repeatable.",
    ),
]
Studies = Annotated[
    list[str] | None,
    typer.Option(metavar="STUDY", help="Sensor Logger study whose uploads are reported; any: all; repeatable."),
]
Lag = Annotated[str, typer.Option(metavar="S", help="Finalise steps older than this; inf or none: never.")]


def serve(
    map_: MapPath = None,
    store: StorePath = None,
    port: Port = 8080,
    host: Host = LOOPBACK,
    token: Token = None,
    user: Users = None,
    out: Folder = Path("pdr-graph-serve"),
    workers: Workers = 1,
    tiles: Tiles = None,
    phyphox: Phones = None,
    mqtt: BrokerUrl = None,
    mqtt_topic: Topic = "sensor-logger",
    home_assistant: HomeAssistant = None,
    heard_as: HeardAs = None,
    study: Studies = None,
    walker: WalkerPath = None,
    beacons: BeaconsPath = None,
    radio_map: RadioMapPath = None,
    paths: PathsPath = None,
    floor: FloorLabel = None,
    lag: Lag = "60",
    settings: Settings = None,
) -> None:
    """Show live phones on a map.

    Phones send their sensors with the app Sensor Logger, or positions with OwnTracks, Overland or Traccar Client.

    \b
    pdr-graph serve                                    only from this machine
    pdr-graph serve --host 0.0.0.0 --map plan.geojson  phones in the network, with a token
    """
    try:
        from pdr_graph.apps.serve import serving
    except ImportError as error:
        raise InputError("serve", error.name or "", "no such package", install("serve")) from None
    from pdr_graph.apps.serve.access import LOCAL_HOSTS, load_tokens
    from pdr_graph.apps.serve.application import checked_tiles
    from pdr_graph.apps.serve.pulling import PhyphoxPhone, Sources, broker_of
    from pdr_graph.apps.serve.receivers import receivers_of
    from pdr_graph.apps.serve.study import StudyReports

    options = {"plan": map_, "walker": walker, "beacons": beacons, "radio_map": radio_map}
    options |= {"paths": paths, "floor": floor, "lag": lag_seconds(lag), "settings": tuple(settings or ())}
    building, placed = serving.read_inputs(options)
    out.mkdir(parents=True, exist_ok=True, mode=0o700)
    file = out / serving.TOKENS
    secured = host not in LOCAL_HOSTS or token is not None or bool(user) or file.exists()
    tokens = load_tokens(file, user or (), token) if secured else {}
    reports = StudyReports(out / STUDY, study, map_, serving.say) if study else None
    for url in phyphox or ():
        PhyphoxPhone(url)  # refuses what is no address
    home = broker_of(home_assistant, "pdr_graph", "--home-assistant") if home_assistant else None
    receivers = receivers_of(home, heard_as, placed.name if placed else ()) if heard_as else None
    pulled = broker_of(mqtt, mqtt_topic) if mqtt else None
    sources = Sources(tuple(phyphox or ()), pulled, reports, home, receivers)
    server = serving.Settings(out, options, store, workers, tokens, checked_tiles(tiles), sources=sources)
    app = serving.build(server, building)
    serving.serve(app, host, port, lambda port: _print_addresses(serving.addresses(host, port), tokens, file))


LIFELOG_PORT = 8081  # not that of `serve`


def serve_lifelog(
    store: Annotated[Path, typer.Argument(metavar="STORE", help="The lifelog.")],
    port: Port = LIFELOG_PORT,
    tiles: Tiles = None,
) -> None:
    """Show and correct days in the browser, on this machine alone.

    The address that is printed has a token that is valid until Ctrl-C.

    \b
    pdr-graph lifelog serve days.db
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
        push = f"{addresses[0]}/sensorlogger{query}"
        echo(f"Sensor Logger{of}, Settings, Data Streaming, Push URL: {push}")
        if sys.stdout.isatty():
            import segno

            segno.make(push, error="l").terminal(compact=True)
    if tokens:
        echo(f"tokens are in {file}; Ctrl-C ends")
    sys.stdout.flush()
