"""Ask one question at a time, about the newest message, without blocking the caller."""

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
    """The result of one question.

    Attributes:
        about: the message of the question.
        future: completed future with the answer or the error.
        superseded: number of messages since the last outcome that a newer message replaced.
    """

    about: T
    future: Future[AnswerT]
    superseded: int


class Latest(Generic[T, AnswerT]):
    """Ask about the newest message, in a separate thread.

    `see` and `tick` return at once. Call `see` from the callback of a subscription, and `tick` from
    the callback of a timer. While a question is in progress, only the newest message is kept.

    Args:
        ask: function that returns the answer to a message; called in the thread.
    """

    def __init__(self, ask: Callable[[T], AnswerT]) -> None:
        self._ask = ask
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="scene")
        self._lock = Lock()  # a multi-threaded ROS executor may run both callbacks at once
        self._waiting: list[T] = []  # at most one message
        self._superseded = 0
        self._in_progress: tuple[T, Future[AnswerT]] | None = None

    def see(self, message: T) -> None:
        """Keep a message for the next question. It replaces a waiting message."""
        with self._lock:
            self._superseded += len(self._waiting)
            self._waiting = [message]

    def tick(self) -> Outcome[T, AnswerT] | None:
        """Return the outcome of a question, and start the next question if possible.

        The result is None if no question has ended since the last call.
        """
        with self._lock:
            outcome = None
            if self._in_progress is not None and self._in_progress[1].done():
                outcome = Outcome(*self._in_progress, self._superseded)
                self._in_progress, self._superseded = None, 0
            if self._in_progress is None and self._waiting:
                message = self._waiting.pop()
                self._in_progress = message, self._thread.submit(self._ask, message)
            return outcome

    def close(self) -> None:
        """Stop asking. The question in progress ends within the client's timeout."""
        self._thread.shutdown(wait=False, cancel_futures=True)
