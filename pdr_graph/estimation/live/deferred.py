"""A long computation beside a walk under way, whose result is used at a fixed later time of the walk.

So no push waits for it, and the walk is the same whether it was computed in an idle moment, by another thread, or only
when it was due.
"""

from __future__ import annotations

from concurrent.futures import Executor, Future
from typing import Generic, Protocol, TypeVar

import numpy as np

Answer = TypeVar("Answer", covariant=True)
Result = TypeVar("Result")


class Question(Protocol[Answer]):
    """A computation over data that do not change any more."""

    def answer(self) -> Answer:
        """The result."""
        ...


class Deferred(Generic[Result]):
    """At most one question at a time. due: time of the walk [s] from which the answer is used.

    executor: computes the answers; by default `work` does, or `collect` when the answer is due.
    """

    def __init__(self, executor: Executor | None = None) -> None:
        self.executor, self.due = executor, np.inf
        self._question: Question[Result] | None = None
        self._future: Future[Result] | None = None
        self._answer: Result | None = None

    @property
    def idle(self) -> bool:
        """True if there is no question."""
        return self._question is None and self._answer is None

    def ask(self, question: Question[Result], due: float) -> None:
        """Ask a question, whose answer is used from the time ``due`` [s] on; an open one is dropped."""
        self.cancel()
        self._question, self.due = question, due
        if self.executor is not None:
            self._future = self.executor.submit(question.answer)

    def work(self) -> Result | None:
        """Compute the answer now, or wait for the executor's; None without a question."""
        if self._question is not None:
            self._answer = self._question.answer() if self._future is None else self._future.result()
            self._question = self._future = None
        return self._answer

    def collect(self, now: float) -> Result | None:
        """The answer if it is due at ``now`` [s], once; else None."""
        if now < self.due:
            return None
        answer = self.work()
        self.cancel()
        return answer

    def cancel(self) -> None:
        """Drop the question and its answer."""
        if self._future is not None:
            self._future.cancel()
        self._question, self._future, self._answer, self.due = None, None, None, np.inf
