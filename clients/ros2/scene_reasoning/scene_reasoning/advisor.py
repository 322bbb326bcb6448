"""What a node does apart from ROS: from a message of detections to answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from scene_client.ros_fields import LabelMap, read_label_map
from scene_client.schemas import Answer
from scene_client.vision_msgs import SceneFields, Viewpoint, from_message

QUESTIONS = ("missing", "outliers", "relations")


class Asker(Protocol):
    """The three questions about a scene, as `scene_client.Client` answers them."""

    def missing(self, **fields: Any) -> Answer: ...
    def outliers(self, **fields: Any) -> Answer: ...
    def relations(self, **fields: Any) -> Answer: ...


@dataclass(frozen=True)
class Advice:
    """What the service says of one message.

    Attributes:
        fields: what was asked, with notes on what was left out.
        answers: by question, as JSON; empty where nothing was seen.
    """

    fields: SceneFields
    answers: dict[str, dict[str, Any]]

    def to_json(self) -> dict[str, Any]:
        """What subscribers get: the header of the detections, the answers, and the notes."""
        return {
            "frame_id": self.fields.get("frame_id"),
            "stamp": self.fields.get("stamp"),
            **self.answers,
            "notes": [note._asdict() for note in self.fields.notes],
        }


@dataclass
class Advisor:
    """Turns a message into a request and asks.

    Attributes:
        client: who is asked.
        questions: which of `QUESTIONS`.
        label_map: what the class ids mean; may be replaced at any time.
        min_score: leave out what the detector is less sure of.
        boxes: False where boxes are pixels: positions are then those of the hypotheses.
        own: fields of a question of its own, such as ``{"missing": {"top_k": 5}}``.

    Raises:
        ValueError: a question that there is none, or a wrong label map.
    """

    client: Asker
    questions: Sequence[str] = ("missing", "outliers")
    label_map: LabelMap | None = None
    min_score: float = 0.0
    boxes: bool = True
    own: dict[str, dict[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.questions or not set(self.questions) <= set(QUESTIONS):
            raise ValueError(f"questions must be some of {', '.join(QUESTIONS)}")
        read_label_map(self.label_map)

    def advise(self, message: Any, viewpoint: Viewpoint | None = None) -> Advice:
        """Ask every question about the detections of a message.

        Raises:
            MessageError: no scene can be made of it.
            ClientError: a question has no answer.
        """
        fields = from_message(
            message,
            self.label_map,
            min_score=self.min_score,
            boxes=self.boxes,
            viewpoint=viewpoint,
        )
        if not fields["objects"]:
            return Advice(fields, {})
        answers = {}
        for question in self.questions:
            answer = getattr(self.client, question)(**fields, **self.own.get(question, {}))
            answers[question] = answer.model_dump(mode="json", exclude={"frame_id", "stamp"})
        return Advice(fields, answers)
