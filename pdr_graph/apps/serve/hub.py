"""The published state of all walkers: the last pose and the path of each, and the subscribers that hear of changes.

All of it belongs to the thread of the event loop. A slow subscriber costs no memory: it has one pending pose a walker,
the last, and points of the path are taken from the state of the walker when they are sent.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from pdr_graph.apps.serve.publishing import PATH_KEYS

Event = tuple[str, dict[str, Any]]  # name and data
MOST_SUBSCRIBERS = 100


@dataclass
class Published:
    """The last pose of a walker and its path, in columns; user: to whom it belongs; revision: of the finalised part."""

    user: str
    pose: dict[str, Any]
    finalised: dict[str, Any] = field(default_factory=lambda: {name: [] for name in PATH_KEYS})
    current: dict[str, Any] = field(default_factory=lambda: {name: [] for name in PATH_KEYS})
    revision: int = 0

    def extend(self, path: dict[str, Any]) -> None:
        """Take over an event ``path``, whose ``from`` is the number of points that stay."""
        count, new = path["from"], path["finalised"]
        if count < len(self.finalised["time"]) or (new["lon"] is None) != (self.finalised["lon"] is None):
            self.revision += 1
        self.finalised = {
            name: None if new[name] is None else (self.finalised[name] or [])[:count] + new[name] for name in PATH_KEYS
        }
        self.current = path["current"]

    def path(self, count: int) -> dict[str, Any]:
        """The event ``path`` for a subscriber who has ``count`` finalised points."""
        finalised = {name: None if column is None else column[count:] for name, column in self.finalised.items()}
        return {"id": self.pose["id"], "from": count, "finalised": finalised, "current": self.current}


class Subscriber:
    """A connection that receives events. sees: whether it may see the walker of a user."""

    def __init__(self, hub: Hub, sees: Callable[[str], bool]):
        self._hub, self.sees = hub, sees
        self._poses, self._paths, self._forgotten = dict[str, None](), dict[str, None](), dict[str, None]()
        self._sent = dict[str, tuple[int, int]]()  # revision and number of finalised points
        self._changed = asyncio.Event()
        for id_, walker in hub.walkers.items():
            self.note(id_, walker.user, "pose")
            self.note(id_, walker.user, "path")

    def note(self, id_: str, user: str, kind: str) -> None:
        """Note that there is news of a walker."""
        if not self.sees(user):
            return
        pending = {"pose": self._poses, "path": self._paths, "forgotten": self._forgotten}
        pending[kind][id_] = None
        self._changed.set()

    def wake(self) -> None:
        """End a `wait`."""
        self._changed.set()

    async def wait(self, timeout: float) -> bool:
        """Wait for news; False after ``timeout`` [s] without any."""
        try:
            await asyncio.wait_for(self._changed.wait(), timeout)
        except TimeoutError:
            return False
        return True

    def events(self) -> Iterator[Event]:
        """Yield the pending events; each is made when it is asked for."""
        self._changed.clear()
        while self._forgotten:
            id_, _ = self._forgotten.popitem()
            self._sent.pop(id_, None)
            yield "forgotten", {"id": id_}
        while self._poses:
            walker = self._hub.walkers.get(_first(self._poses))
            if walker is not None:
                yield "pose", walker.pose
        while self._paths:
            id_ = _first(self._paths)
            walker = self._hub.walkers.get(id_)
            if walker is not None:
                revision, count = self._sent.get(id_, (-1, 0))
                path = walker.path(count if revision == walker.revision else 0)
                self._sent[id_] = walker.revision, len(walker.finalised["time"])
                yield "path", path


def _first(pending: dict[str, None]) -> str:
    """Remove and return the oldest key."""
    key = next(iter(pending))
    del pending[key]
    return key


class Hub:
    """All walkers and subscribers."""

    def __init__(self) -> None:
        self.walkers = dict[str, Published]()
        self.closed = False
        self._subscribers = set[Subscriber]()

    def close(self) -> None:
        """Wake all subscribers, whose connections end since the server does."""
        self.closed = True
        for subscriber in self._subscribers:
            subscriber.wake()

    def pose(self, user: str, pose: dict[str, Any]) -> None:
        """Publish a pose; the first creates the walker."""
        walker = self.walkers.get(pose["id"])
        if walker is None:
            self.walkers[pose["id"]] = Published(user, pose)
        else:
            walker.pose = pose
        self._note(pose["id"], user, "pose")

    def path(self, path: dict[str, Any]) -> None:
        """Publish an event ``path`` of a walker that has a pose."""
        walker = self.walkers.get(path["id"])
        if walker is not None:
            walker.extend(path)
            self._note(path["id"], walker.user, "path")

    def forget(self, id_: str) -> None:
        """Remove a walker."""
        walker = self.walkers.pop(id_, None)
        if walker is not None:
            self._note(id_, walker.user, "forgotten")

    def subscribe(self, sees: Callable[[str], bool]) -> Subscriber | None:
        """A new subscriber, for whom all walkers are news; None if there are MOST_SUBSCRIBERS."""
        if len(self._subscribers) >= MOST_SUBSCRIBERS:
            return None
        subscriber = Subscriber(self, sees)
        self._subscribers.add(subscriber)
        return subscriber

    def unsubscribe(self, subscriber: Subscriber) -> None:
        """Remove a subscriber."""
        self._subscribers.discard(subscriber)

    def _note(self, id_: str, user: str, kind: str) -> None:
        for subscriber in self._subscribers:
            subscriber.note(id_, user, kind)
