"""The part of the node that does not need ROS: turn a message of detections into answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from scene_client.ros_fields import LabelMap, read_label_map
from scene_client.schemas import Answer, UnknownLabels
from scene_client.vision_msgs import SceneFields, Viewpoint, from_message

QUESTIONS = ("missing", "outliers", "relations", "rooms")


class Asker(Protocol):
    """The methods of `scene_client.Client` that an `Advisor` calls."""

    def missing(self, **fields: Any) -> Answer: ...
    def outliers(self, **fields: Any) -> Answer: ...
    def relations(self, **fields: Any) -> Answer: ...
    def rooms(self, **fields: Any) -> Answer: ...


@dataclass(frozen=True)
class Advice:
    """The answers to the questions about one message.

    Attributes:
        fields: fields of the request, with notes on the detections that were left out.
        answers: question to answer as JSON; empty if the message has no objects.
    """

    fields: SceneFields
    answers: dict[str, dict[str, Any]]

    def to_json(self) -> dict[str, Any]:
        """The published message: header of the detections, answers and notes."""
        return {
            "frame_id": self.fields.get("frame_id"),
            "stamp": self.fields.get("stamp"),
            **self.answers,
            "notes": [note._asdict() for note in self.fields.notes],
        }


@dataclass
class Advisor:
    """Convert messages to requests and send them to the service.

    Attributes:
        client: client of the service.
        questions: one or more of `QUESTIONS`.
        label_map: labels of the class ids; may be replaced at any time.
        min_score: detections with a lower score are left out.
        unknown_labels: treatment of labels that the model does not know.
        boxes: False if boxes are in pixels; positions are then taken from the hypotheses.
        conventions: fields that declare the conventions of the boxes, such as ``{"units": "cm"}``.
        own: extra fields for each question, such as ``{"missing": {"top_k": 5}}``.

    Raises:
        ValueError: an unknown question, or an invalid label map.
    """

    client: Asker
    questions: Sequence[str] = ("missing", "outliers")
    label_map: LabelMap | None = None
    min_score: float = 0.0
    unknown_labels: UnknownLabels = "nearest-or-ignore"
    boxes: bool = True
    conventions: dict[str, str] = field(default_factory=dict)
    own: dict[str, dict[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.questions or not set(self.questions) <= set(QUESTIONS):
            raise ValueError(f"questions must be some of {', '.join(QUESTIONS)}")
        read_label_map(self.label_map)

    def advise(self, message: Any, viewpoint: Viewpoint | None = None) -> Advice:
        """Ask every question about the detections of a message.

        Raises:
            MessageError: the message cannot be converted to a scene.
            ClientError: the service did not answer a question.
        """
        fields = from_message(
            message,
            self.label_map,
            min_score=self.min_score,
            unknown_labels=self.unknown_labels,
            boxes=self.boxes,
            viewpoint=viewpoint,
        )
        fields.update(self.conventions)
        if not fields["objects"]:
            return Advice(fields, {})
        answers = {}
        for question in self.questions:
            answer = getattr(self.client, question)(**fields, **self.own.get(question, {}))
            answers[question] = answer.model_dump(
                mode="json", exclude={"frame_id", "stamp"}, exclude_none=True
            )
        return Advice(fields, answers)
