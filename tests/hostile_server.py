"""A server that attacks its clients: each attack is what it does with a connection whose request has arrived."""

import functools
import socket
import threading
import time
import zlib
from contextlib import contextmanager, suppress

OK = b"HTTP/1.1 200 OK\r\n"
LONGEST = 900.0  # [s] after which an attack ends by itself


def slowly(pieces, pause):
    """Send pieces with pauses [s], until the client goes."""

    def attack(client, _):
        end = time.monotonic() + LONGEST
        for piece in pieces():
            client.sendall(piece)
            time.sleep(pause)
            if time.monotonic() > end:
                return

    return attack


def forever(*first, again):
    """A function that yields some bytes, then others for ever."""

    def pieces():
        yield from first
        while True:
            yield again

    return pieces


def hold(*pieces):
    """Send something and keep the connection open."""

    def attack(client, _):
        for piece in pieces:
            client.sendall(piece)
        client.settimeout(LONGEST)
        client.recv(1)

    return attack


def closing(*pieces):
    """Send something and close."""

    def attack(client, _):
        for piece in pieces:
            client.sendall(piece)

    return attack


def body(content, *headers):
    """A whole answer."""
    head = b"".join(header + b"\r\n" for header in headers)
    return closing(OK + head + b"Content-Length: %d\r\n\r\n" % len(content), content)


def redirect(target, code=302):
    """A redirect, to this server where the target begins with a slash."""

    def attack(client, host):
        location = f"http://{host}{target}" if target.startswith("/") else target
        client.sendall(f"HTTP/1.1 {code} Found\r\nLocation: {location}\r\nContent-Length: 0\r\n\r\n".encode())

    return attack


def reset(client, _):
    """Close with a reset."""
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")


@functools.cache
def bomb():
    """A quarter of a gigabyte of zeros, packed piece by piece: the server stays small."""
    packer = zlib.compressobj(9, wbits=31)
    return b"".join([*(packer.compress(bytes(1 << 20)) for _ in range(256)), packer.flush()])


CHUNKED = OK + b"Transfer-Encoding: chunked\r\n\r\n"
BLOCK = b"x" * 65536
ATTACKS = {
    "no answer": hold(),
    "reset": reset,
    "closed at once": closing(),
    "half-closed after the head": closing(OK + b"Content-Length: 100\r\n\r\n"),
    "a byte of the status line each 0.2 s": slowly(forever(again=b"H"), 0.2),
    "a byte of a header each 0.2 s": slowly(forever(OK + b"X: ", again=b"a"), 0.2),
    "a header each 0.2 s": slowly(forever(OK, again=b"X: a\r\n"), 0.2),
    "a byte of the body each 0.2 s": slowly(forever(OK + b"\r\n", again=b"1"), 0.2),
    "a byte of the body each 0.2 s, length stated": slowly(
        forever(OK + b"Content-Length: 90000\r\n\r\n", again=b"1"), 0.2
    ),
    "a byte of a chunk's size each 0.2 s": slowly(forever(CHUNKED, again=b"0"), 0.2),
    "chunks of a byte each 0.2 s": slowly(forever(CHUNKED, again=b"1\r\nx\r\n"), 0.2),
    "trailers without end": slowly(forever(CHUNKED + b"0\r\n", again=b"X: a\r\n" * 100), 0.01),
    "100 Continue without end": slowly(forever(again=b"HTTP/1.1 100 Continue\r\n\r\n" * 10), 0.05),
    "a body without end": slowly(forever(OK + b"\r\n", again=BLOCK), 0),
    "chunks without end": slowly(forever(CHUNKED, again=b"10000\r\n" + BLOCK + b"\r\n"), 0),
    "a chunk of 10^18 bytes": slowly(forever(CHUNKED + b"de0b6b3a7640000\r\n", again=BLOCK), 0),
    "a status line without end": slowly(forever(again=BLOCK), 0),
    "a header without end": slowly(forever(OK + b"X: ", again=BLOCK), 0),
    "10^6 headers": closing(OK, b"X: a\r\n" * 10**6, b"\r\n"),
    "a redirect to itself": redirect("/evaalapi/t/state"),
    "a redirect to file:///etc/passwd": redirect("file:///etc/passwd"),
    "a redirect to another host": redirect("http://192.0.2.1/"),
    "a redirect to FTP": redirect("ftp://192.0.2.1/x"),
    "a redirect to no address": redirect("http://[::bad"),
    "a bomb of gzip": lambda *at: body(bomb(), b"Content-Encoding: gzip")(*at),
    "a length too short": closing(OK + b"Content-Length: 5\r\n\r\n", b"0,1,2,3,4,5,6,0;0;0" * 100),
    "a length too long, closed": closing(OK + b"Content-Length: 1000\r\n\r\n", b"0,1"),
    "a length too long, open": hold(OK + b"Content-Length: 1000\r\n\r\n", b"0,1"),
    "a length of 10^18": closing(OK + b"Content-Length: 1000000000000000000\r\n\r\n", b"0,1"),
    "a length of 10^5 digits": closing(OK + b"Content-Length: " + b"9" * 60000 + b"\r\n\r\n", b"0,1"),
    "a negative length": hold(OK + b"Content-Length: -5\r\n\r\n", b"0,1"),
    "two lengths": closing(OK + b"Content-Length: 3\r\nContent-Length: 90\r\n\r\n", b"0,1"),
    "a garbage status line": closing(b"SSH-2.0-OpenSSH_9.6\r\n\r\n"),
    "random bytes": closing(bytes(range(256)) * 4096),
    "status 99999": closing(b"HTTP/1.1 99999 Odd\r\n\r\n"),
    "JSON nested 10^5 deep": body(b"[" * 100_000),
    "JSON of NaN": body(b'[{"event": "START", "experimentTime": NaN, "systemTime": 1e999}]'),
    "a state of NaN": body(b"nan,nan,nan,nan,nan,nan,nan,nan"),
    "control characters": body(b"\x1b[2J\x07\r\n\0" * 100),
    "an empty answer": body(b""),
    "423, again and again": closing(b"HTTP/1.1 423 Locked\r\nContent-Length: 0\r\n\r\n"),
    "500": closing(b"HTTP/1.1 500 Oops\r\nContent-Length: 0\r\n\r\n"),
}


@contextmanager
def attacking(answer):
    """Serve connections: ``answer(path)`` is the attack for a request. Yields host and port, and the paths asked."""
    paths, open_sockets = [], []
    server = socket.create_server(("127.0.0.1", 0), backlog=128)
    host = f"127.0.0.1:{server.getsockname()[1]}"

    def serve(client):
        try:
            client.settimeout(30.0)
            request = b""
            while b"\r\n\r\n" not in request and len(request) < 1 << 20:
                piece = client.recv(65536)
                if not piece:
                    return
                request += piece
            path = request.split(b" ", 2)[1].decode("ascii", "replace")
            paths.append(path)
            client.settimeout(None)
            answer(path)(client, host)
        except OSError:
            pass  # the client has gone, or the test is over
        finally:
            client.close()

    def accept():
        while True:
            try:
                client, _ = server.accept()
            except OSError:
                return
            open_sockets.append(client)
            threading.Thread(target=serve, args=(client,), daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()
    try:
        yield host, paths
    finally:
        server.close()
        for client in open_sockets:
            with suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)
