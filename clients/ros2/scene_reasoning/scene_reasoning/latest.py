"""One question at a time, always about the newest thing, without ever waiting for it."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from threading import Lock
from typing import Generic, TypeVar

T = TypeVar("T")
AnswerT = TypeVar("AnswerT")


@dataclass(frozen=True)
class Outcome(Generic[T, AnswerT]):
    """What became of one question.

    Attributes:
        about: what was asked about.
        future: done: holds the answer, or the error.
        superseded: how many newer things came and went before anybody could ask about them, since
            the outcome before this one.
    """

    about: T
    future: Future[AnswerT]
    superseded: int


class Latest(Generic[T, AnswerT]):
    """Asks about the newest thing seen, in a thread of its own.

    `see` and `tick` return at once, whatever the service does: put them into the callbacks of a
    subscription and a timer. While a question is in flight newer things replace each other.

    Args:
        ask: answers, or raises; called in the thread.
    """

    def __init__(self, ask: Callable[[T], AnswerT]) -> None:
        self._ask = ask
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="scene")
        self._lock = Lock()  # a multi-threaded executor may run both callbacks at once
        self._waiting: list[T] = []
        self._superseded = 0
        self._asked: tuple[T, Future[AnswerT]] | None = None

    def see(self, thing: T) -> None:
        """Remember it in place of whatever was waiting."""
        with self._lock:
            self._superseded += len(self._waiting)
            self._waiting = [thing]

    def tick(self) -> Outcome[T, AnswerT] | None:
        """Take the outcome if there is one, and ask about the newest thing if nobody is asking."""
        with self._lock:
            outcome = None
            if self._asked is not None and self._asked[1].done():
                outcome = Outcome(*self._asked, self._superseded)
                self._asked, self._superseded = None, 0
            if self._asked is None and self._waiting:
                thing = self._waiting.pop()
                self._asked = thing, self._thread.submit(self._ask, thing)
            return outcome

    def close(self) -> None:
        """Ask no more. The question in flight ends with its own timeout."""
        self._thread.shutdown(wait=False, cancel_futures=True)
