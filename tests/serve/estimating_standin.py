"""A stand-in for an estimating process, which some walkers kill and others freeze."""

import os
import signal
import time

import msgspec


def run_process(connection, root, options, working):
    def send(kind, update):
        connection.send_bytes(msgspec.msgpack.encode((kind, update)))

    send("ready", {})
    while True:
        try:
            action, id_ = msgspec.msgpack.decode(connection.recv_bytes())
        except EOFError:
            return
        if action == "stop":
            return
        if action == "ping":
            send("ping", {})
            continue
        working.value = id_.encode()
        if id_.startswith("deadly"):
            os.kill(os.getpid(), signal.SIGKILL)
        while id_.startswith("freezing"):
            time.sleep(1.0)
        working.value = b""
        send("looked", {"id": id_})
