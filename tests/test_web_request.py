"""Requests to hostile servers end in time, read no more than allowed, and lead nowhere else."""

import socket
import threading
import time
from contextlib import suppress

import hostile_server
import pytest
from hostile_server import ATTACKS, attacking, body, redirect

from pdr_graph import web_request
from pdr_graph.web_request import TooLongError, ask

SILENCE, WHOLE = 0.5, 1.0  # [s]
MARGIN = 5.0  # [s] on a machine under load
MOST = 1 << 20  # bytes
SHORT = (
    "to itself",
    "to file",
    "to another",
    "to FTP",
    "gzip",
    "short",
    "JSON",
    "state of",
    "control",
    "empty",
    "423",
    "500",
)


@pytest.fixture(autouse=True)
def attacks_end(monkeypatch):
    """By themselves, so that a test without the deadline fails and does not hang."""
    monkeypatch.setattr(hostile_server, "LONGEST", 2 * MARGIN + WHOLE)


def fetched(host, path="/", **more):
    """Status and body of an answer."""
    answer = ask(f"http://{host}{path}", SILENCE, WHOLE, MOST, **more)
    return answer.status, answer.body


@pytest.mark.parametrize("name", ATTACKS)
def test_an_attack_ends_in_time(name):
    """With an error, or with an answer that is not too long and not unpacked."""
    hostile_server.bomb()  # packed once
    began, content = time.monotonic(), None
    with attacking(lambda path: ATTACKS[name]) as (host, _), suppress(OSError):
        _, content = fetched(host)
    assert time.monotonic() - began < WHOLE + MARGIN
    assert (content is not None) == any(word in name for word in SHORT)


@pytest.mark.parametrize("pieces", [[], [b"\x16\x03\x03\x40\x00", *[b"\x02"] * 1000]], ids=["silence", "drips"])
def test_a_tls_handshake_without_end_ends_in_time(pieces):
    with socket.create_server(("127.0.0.1", 0)) as server:

        def drip():
            client, _ = server.accept()
            with client:
                try:
                    for piece in pieces:
                        client.sendall(piece)
                        time.sleep(0.1)
                    client.settimeout(WHOLE + MARGIN)
                    while client.recv(65536):
                        pass
                except OSError:
                    pass

        threading.Thread(target=drip, daemon=True).start()
        began = time.monotonic()
        with pytest.raises(OSError, match=r"no complete answer|Timeout"):
            ask(f"https://127.0.0.1:{server.getsockname()[1]}/", WHOLE, WHOLE, MOST)
        assert time.monotonic() - began < WHOLE + MARGIN


def test_the_deadline_says_how_long_it_was():
    drip = ATTACKS["a byte of the body each 0.2 s"]
    with attacking(lambda path: drip) as (host, _), pytest.raises(TimeoutError, match="no complete answer within 1 s"):
        fetched(host)


def test_a_long_answer_is_cut_off_at_its_limit():
    with attacking(lambda path: body(b"x" * (MOST + 1))) as (host, _), pytest.raises(TooLongError):
        fetched(host)
    with attacking(lambda path: body(b"x" * MOST)) as (host, _):
        assert fetched(host) == (200, b"x" * MOST)


def test_redirects_are_followed_where_the_caller_agrees():
    pages = {"/": redirect("/next"), "/next": body(b"here"), "/round": redirect("/round")}
    with attacking(lambda path: pages[path]) as (host, paths):
        assert fetched(host) == (302, b"")
        assert paths == ["/"]
        assert fetched(host, follow="same host") == (200, b"here")
        with pytest.raises(OSError, match="more than 5 redirects"):
            fetched(host, "/round", follow="public")
    for target in ("http://192.0.2.1/", "https://127.0.0.1.example.org/", "file:///etc/passwd", "ftp://127.0.0.1/"):
        with attacking(lambda path, target=target: redirect(target)) as (host, _):
            assert fetched(host, follow="same host")[0] == 302


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1", "2130706433", "[::ffff:127.0.0.1]", "[::1]", "10.0.0.1"])
def test_a_public_host_leads_into_no_private_network(host, monkeypatch):
    """The first answer comes from this machine, as if it had a public address."""
    is_public = web_request._is_public

    async def first_is_public(name):
        return name == "localhost" or await is_public(name)

    monkeypatch.setattr(web_request, "_is_public", first_is_public)
    secret = body(b"of the private network")
    with attacking(lambda _: secret) as (inside, _):
        target = f"http://{host}:{inside.rpartition(':')[2]}/"
        with attacking(lambda _: redirect(target)) as (outside, _):
            address = f"localhost:{outside.rpartition(':')[2]}"
            assert fetched(address, follow="public")[0] == 302


def test_another_host_gets_no_authorization():
    heads = []

    def noting(client, _):
        client.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\n\r\n")

    with socket.create_server(("127.0.0.1", 0)) as other:

        def serve():
            client, _ = other.accept()
            with client:
                heads.append(client.recv(65536).lower())
                noting(client, _)

        threading.Thread(target=serve, daemon=True).start()
        with attacking(lambda path: redirect(f"http://127.0.0.1:{other.getsockname()[1]}/")) as (host, _):
            secret = {"Authorization": "secret", "X-Kept": "1"}
            answer = ask(f"http://{host}/", SILENCE, WHOLE + MARGIN, MOST, "public", headers=secret)
    assert answer.status == 200
    [head] = heads
    assert b"x-kept: 1" in head
    assert b"secret" not in head


def test_requests_leave_no_thread_and_no_connection():
    with attacking(lambda path: body(b"x")) as (host, _):
        fetched(host)
        before = threading.active_count()
        for _ in range(20):
            fetched(host)
        end = time.monotonic() + MARGIN
        while threading.active_count() > before and time.monotonic() < end:
            time.sleep(0.01)
        assert threading.active_count() <= before
