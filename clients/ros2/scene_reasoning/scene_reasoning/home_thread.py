"""A `scene_client.Home` in a thread of its own, so that callbacks and ticks never wait."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from scene_client import Home

T = TypeVar("T")


class HomeThread:
    """The thread of a home. Only this thread uses the home, so no lock is needed.

    `see` and `ask` return at once.
    """

    def __init__(self, home: Home) -> None:
        self._home = home
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="home")
        self._frame: Future[object] | None = None
        self.replaced = 0  # number of frames that a newer frame has replaced

    def ask(self, question: Callable[[Home], T]) -> Future[T]:
        """Call a function of the home in the thread."""
        return self._thread.submit(question, self._home)

    def see(self, frame: Callable[[Home], object]) -> None:
        """Call a function that updates the home. It replaces a frame that still waits.

        An error of an earlier frame is raised here.
        """
        if self._frame is not None:
            if self._frame.cancel():
                self.replaced += 1
            elif self._frame.done():
                self._frame.result()
        self._frame = self.ask(frame)

    def close(self) -> None:
        """Save the home. The question in progress ends within its timeout."""
        self.ask(Home.close)
        self._thread.shutdown()
