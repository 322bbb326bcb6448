"""Conditions for behaviour trees (py_trees): `SceneComplete` and `ObjectBelongs`.

    scene = lambda: from_detection3d_array(newest_message)
    root.add_children([SceneComplete("table is set", client, scene, candidates=["fork"]), leave])

The first tick of a condition starts a question in a separate thread. The condition is RUNNING until
the answer arrives, so a tick never waits for the service. A condition fails if the scene has no
objects, or if no answer arrives in time. ``feedback_message`` gives the reason, and ``answer`` is
the answer.
"""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from py_trees.behaviour import Behaviour
from py_trees.common import Status

from scene_client import ClientError
from scene_client.ros_fields import MessageError
from scene_client.schemas import MisplacedRelation, MissingAnswer, OutliersAnswer
from scene_reasoning.advisor import Asker

SceneSource = Callable[[], Mapping[str, Any] | None]


class SceneCondition(Behaviour):
    """A condition that asks one question about the newest scene.

    Args:
        name: name of the node in the tree.
        client: client of the service.
        scene: function that returns the fields of a request, or None without objects. It runs in
            the condition's thread, so it may convert detections.
        timeout: seconds from the first tick until the condition fails.
        own: extra fields of the request.
    """

    def __init__(
        self, name: str, client: Asker, scene: SceneSource, *, timeout: float = 1.0, **own: Any
    ) -> None:
        super().__init__(name)
        self.client = client
        self.scene = scene
        self.timeout = timeout
        self.own = own
        self.answer: Any = None
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix=name)
        self._asked: Future[Any] | None = None
        self._until = 0.0

    def initialise(self) -> None:
        self.answer = None
        self._until = time.monotonic() + self.timeout
        self._asked = self._thread.submit(self._ask)

    def update(self) -> Status:
        if self._asked is None or not self._asked.done():
            if time.monotonic() < self._until:
                return Status.RUNNING
            return self._fail("no answer in time")
        try:
            self.answer = self._asked.result()
        except (ClientError, MessageError) as error:
            return self._fail(f"{type(error).__name__}: {error}")
        if self.answer is None:
            return self._fail("nothing was seen")
        holds, self.feedback_message = self.judge(self.answer)
        return Status.SUCCESS if holds else Status.FAILURE

    def terminate(self, new_status: Status) -> None:
        # A running question cannot be cancelled. It ends within the client's timeout, and its
        # answer is ignored.
        if self._asked is not None:
            self._asked.cancel()
            self._asked = None

    def shutdown(self) -> None:
        self._thread.shutdown(wait=False, cancel_futures=True)

    def _ask(self) -> Any:
        fields = self.scene()
        if not fields or not fields.get("objects"):
            return None
        return self.ask({**fields, **self.own})

    def _fail(self, why: str) -> Status:
        self.feedback_message = why
        return Status.FAILURE

    @abstractmethod
    def ask(self, fields: dict[str, Any]) -> Any:
        """Ask the question; called in the condition's thread."""

    @abstractmethod
    def judge(self, answer: Any) -> tuple[bool, str]:
        """Whether the condition holds, and the reason."""


class SceneComplete(SceneCondition):
    """SUCCESS if no unlisted object is likely to be present.

    Args:
        log_odds: an unlisted object counts as missing if its `log_odds` are at least this value. 0
            is a probability of 0.5; 2.2 is a probability of 0.9.
        own: extra fields, such as ``candidates`` (objects to consider) and ``at`` (place).
    """

    def __init__(
        self, name: str, client: Asker, scene: SceneSource, *, log_odds: float = 0.0, **own: Any
    ) -> None:
        super().__init__(name, client, scene, **own)
        self.log_odds = log_odds

    def ask(self, fields: dict[str, Any]) -> MissingAnswer:
        return self.client.missing(**fields)

    def judge(self, answer: MissingAnswer) -> tuple[bool, str]:
        likely = [thing for thing in answer.missing if thing.log_odds >= self.log_odds]
        missing = [thing.listed_as or thing.label for thing in likely]
        return not missing, f"missing: {', '.join(missing)}" if missing else "nothing is missing"


class ObjectBelongs(SceneCondition):
    """SUCCESS if an object fits the scene and its place.

    FAILURE if the object is an outlier, was moved to a wrong place, or is not in the scene. The
    service judges places only of objects with positions or stated relations.

    Args:
        thing: id or label of the object, its class, or a broader class: "lamp" names a floor lamp
            too. Except with an id, every such object must fit.
        own: extra fields, such as ``threshold``, the smallest probability of an outlier.
    """

    def __init__(
        self, name: str, client: Asker, scene: SceneSource, thing: str, **own: Any
    ) -> None:
        super().__init__(name, client, scene, **own)
        self.thing = thing

    def ask(self, fields: dict[str, Any]) -> OutliersAnswer:
        return self.client.outliers(**fields)

    def judge(self, answer: OutliersAnswer) -> tuple[bool, str]:
        named = [entry for entry in answer.outliers if entry.object == self.thing] or [
            entry
            for entry in answer.outliers
            if self.thing in (entry.listed_as, entry.label, *(entry.broader or ()))
        ]
        if not named:
            return False, f"no {self.thing} was seen"
        worst = max(named, key=lambda entry: entry.probability)
        if not worst.is_outlier:
            ids = {entry.object for entry in named}
            for place in answer.misplaced:
                if place.is_misplaced and place.moved in ids:
                    return False, f"{place.moved}: in the wrong place, {_words(place)}"
        text = f"{worst.object}: an outlier with probability {worst.probability:.2f}"
        return not worst.is_outlier, text


def _words(relation: MisplacedRelation) -> str:
    return f"{relation.subject} {relation.relation} {relation.object}"
