"""Conditions for behaviour trees (py_trees): `SceneComplete`, `ObjectBelongs` and `ObjectKnown`.

    home = HomeThread(Home(client, rooms))  # or the `home` of a SceneNode in the same process
    root.add_children([SceneComplete("table is set", home, candidates=["fork"]), leave])

The first tick of a condition starts a question in the thread of the home. The condition is RUNNING
until the answer is there, so a tick never waits. ``feedback_message`` gives the reason for the
result.
"""

from __future__ import annotations

import time
from abc import abstractmethod
from concurrent.futures import Future
from typing import Any

from py_trees.behaviour import Behaviour
from py_trees.common import Status

from scene_client import ClientError, Home
from scene_client.tracks import Track
from scene_reasoning.home_thread import HomeThread


class HomeCondition(Behaviour):
    """A condition about a home.

    Args:
        name: name of the node in the tree.
        home: the thread of the home.
        room: name of the room; by default, `SceneComplete` means the room of the robot, and the
            other conditions mean the whole home.
        timeout: seconds from the first tick until the condition fails.
    """

    def __init__(
        self, name: str, home: HomeThread, *, room: str | None = None, timeout: float = 1.0
    ) -> None:
        super().__init__(name)
        self.home, self.room, self.timeout = home, room, timeout
        self._asked: Future[tuple[bool, str]] | None = None
        self._until = 0.0

    def initialise(self) -> None:
        self._until = time.monotonic() + self.timeout
        self._asked = self.home.ask(self.judge)

    def update(self) -> Status:
        if self._asked is None or not self._asked.done():
            if time.monotonic() < self._until:
                return Status.RUNNING
            holds, self.feedback_message = False, "no answer in time"
        else:
            holds, self.feedback_message = self._asked.result()
        return Status.SUCCESS if holds else Status.FAILURE

    def terminate(self, new_status: Status) -> None:
        # A running question cannot be cancelled. Its answer is ignored.
        if self._asked is not None:
            self._asked.cancel()
            self._asked = None

    @abstractmethod
    def judge(self, home: Home) -> tuple[bool, str]:
        """Whether the condition holds, and the reason; called in the thread of the home."""


class SceneComplete(HomeCondition):
    """SUCCESS if no absent object is likely to be in the room. FAILURE if the room is empty.

    Args:
        log_odds: an absent object counts as missing if its `log_odds` are at least this value. 0 is
            a probability of 0.5; 2.2 is a probability of 0.9.
        own: extra fields of the request, such as ``candidates`` (objects to consider) and ``at``
            (place).
    """

    def __init__(
        self,
        name: str,
        home: HomeThread,
        *,
        room: str | None = None,
        timeout: float = 1.0,
        log_odds: float = 0.0,
        **own: Any,
    ) -> None:
        super().__init__(name, home, room=room, timeout=timeout)
        self.log_odds, self.own = log_odds, own

    def judge(self, home: Home) -> tuple[bool, str]:
        if not home.scene(self.room)["objects"]:
            return False, "nothing was seen"
        try:
            answer = home.missing(self.room, **self.own)
        except ClientError as error:
            return False, f"{type(error).__name__}: {error}"
        likely = [one for one in answer.missing if one.log_odds >= self.log_odds]
        missing = [one.listed_as or one.label for one in likely]
        return not missing, f"missing: {', '.join(missing)}" if missing else "nothing is missing"


class ObjectKnown(HomeCondition):
    """SUCCESS if an object is present.

    Args:
        thing: id or label of the object.
        options: `room` and `timeout`.
    """

    def __init__(self, name: str, home: HomeThread, thing: str, **options: Any) -> None:
        super().__init__(name, home, **options)
        self.thing = thing

    def judge(self, home: Home) -> tuple[bool, str]:
        found = [one.id for one in self.found(home)]
        return bool(found), f"present: {', '.join(found)}" if found else f"no {self.thing} was seen"

    def found(self, home: Home) -> list[Track]:
        """Return the present things of this id or label."""
        return [one for one in home.things(self.room) if self.thing in (one.id, one.label)]


class ObjectBelongs(ObjectKnown):
    """SUCCESS if an object is present, and no object of its label has an alarm. It asks nothing."""

    def judge(self, home: Home) -> tuple[bool, str]:
        ids = {one.id for one in self.found(home)}
        for alarm in home.alarms:
            if alarm.id in ids:
                return False, f"{alarm.label} {alarm.id}: {alarm.kind}, {alarm.probability:.2f}"
        return (True, f"{self.thing} belongs") if ids else (False, f"no {self.thing} was seen")
