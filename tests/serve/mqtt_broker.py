"""A broker for tests: MQTT 3.1.1 with quality of service 0 and exact topics, over TCP."""

import asyncio
from contextlib import asynccontextmanager

CONNECT, CONNACK, PUBLISH, SUBSCRIBE, SUBACK = 1, 2, 3, 8, 9
ACCEPTED, BAD_CREDENTIALS = 0, 4


def packet(kind, body, flags=0):
    size, length = len(body), bytearray()
    while True:
        size, digit = divmod(size, 128)
        length.append(digit | (128 if size else 0))
        if not size:
            return bytes([kind << 4 | flags]) + bytes(length) + body


async def received(reader):
    """Kind and body of the next packet."""
    head, size, shift = (await reader.readexactly(1))[0], 0, 0
    while True:
        digit = (await reader.readexactly(1))[0]
        size |= (digit & 127) << shift
        shift += 7
        if not digit & 128:
            return head >> 4, await reader.readexactly(size)


def text(body, at):
    """A text at an offset of a body, and the offset behind it."""
    end = at + 2 + int.from_bytes(body[at : at + 2], "big")
    return body[at + 2 : end].decode(), end


class Broker:
    """password: that clients need, None without; subscribers: writers by topic."""

    def __init__(self):
        self.password, self.subscribers, self.writers = None, {}, set()

    async def serve(self, reader, writer):
        self.writers.add(writer)
        try:
            while True:
                kind, body = await received(reader)
                if kind == CONNECT:
                    accepted = self.password is None or body.endswith(self.password.encode())  # its last field
                    writer.write(packet(CONNACK, bytes([0, ACCEPTED if accepted else BAD_CREDENTIALS])))
                elif kind == SUBSCRIBE:
                    topic, _ = text(body, 2)
                    self.subscribers.setdefault(topic, set()).add(writer)
                    writer.write(packet(SUBACK, body[:2] + b"\0"))
                elif kind == PUBLISH:
                    topic, _ = text(body, 0)
                    for other in self.subscribers.get(topic, ()):
                        other.write(packet(PUBLISH, body))
        except (asyncio.IncompleteReadError, ConnectionError):
            pass
        finally:
            self.writers.discard(writer)
            for others in self.subscribers.values():
                others.discard(writer)
            writer.close()

    def drop_all(self):
        """Lose all connections."""
        for writer in list(self.writers):
            writer.transport.abort()


@asynccontextmanager
async def running(broker):
    """Serve on a free port of this machine, which it yields."""
    server = await asyncio.start_server(broker.serve, "127.0.0.1", 0)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        server.close()
        broker.drop_all()
