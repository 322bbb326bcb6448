"""Example scenes of a model, for the visual page. The manifest contains them."""

from __future__ import annotations

import math
from typing import Annotated, Any, Final, Literal, Self

from pydantic import AfterValidator, Field, StringConstraints, field_validator, model_validator

from app.registry.fields import Frozen, Many, to_json
from app.scene.relations import RELATIONS, canonicalise
from app.scene.scene import Scene, SceneObject
from app.scene.vocabulary import Vocabulary

MAX_EXAMPLES: Final = 8
MAX_WORD: Final = 100
MAX_OBJECTS: Final = 64
MAX_EXAMPLES_BYTES: Final = 32_768
"""Maximum size of all examples of a model as JSON, in bytes."""


def _plain(text: str) -> str:
    if not text.strip() or not text.isprintable():
        raise ValueError("the text must be printable, and must not be blank")
    return text


def _relation(name: str) -> str:
    if name not in RELATIONS:
        raise ValueError(f"the relation must be one of {', '.join(RELATIONS)}")
    return name


Word = Annotated[str, StringConstraints(max_length=MAX_WORD), AfterValidator(_plain)]
Metres = Annotated[float, Field(ge=-1e4, le=1e4)]
Extent = Annotated[float, Field(gt=0, le=1e4)]


Point = Annotated[dict[Literal["x", "y", "z"], Metres], Field(min_length=3)]
Extents = Annotated[dict[Literal["x", "y", "z"], Extent], Field(min_length=3)]


def _unit(rotation: dict[str, float]) -> dict[str, float]:
    if abs(math.hypot(*rotation.values()) - 1) > 0.01:
        raise ValueError("the orientation must be a unit quaternion (length 1)")
    return rotation


Quaternion = Annotated[
    dict[Literal["x", "y", "z", "w"], float], Field(min_length=4), AfterValidator(_unit)
]


class View(Frozen):
    """Position of the viewer in metres, and its viewing direction in radians."""

    x: Metres
    y: Metres
    yaw: Annotated[float, Field(ge=-1e3, le=1e3)]


class ExampleObject(Frozen):
    """An object of an example: a label, and optionally an id and a pose."""

    label: Word
    id: Word | None = None
    position: Point | None = None
    size: Extents | None = None
    orientation: Quaternion | None = None


class ExampleRelation(Frozen):
    """A relation that holds. `subject` and `object` are ids, or labels of objects without an id."""

    subject: Word
    relation: Annotated[str, AfterValidator(_relation)]
    object: Word


class ExampleScene(Frozen):
    """A scene with the fields and the meaning of a request to the service.

    Raises:
        ValueError: two objects have the same name, a relation names no object of the scene, or two
            relations contradict each other. The name of an object is its id, or its label if it has
            no id.
    """

    objects: Annotated[Many[ExampleObject], Field(min_length=1, max_length=MAX_OBJECTS)]
    relations: Annotated[Many[ExampleRelation], Field(max_length=256)] = ()
    room_type: Word | None = None
    frame_id: Word | None = None
    viewpoint: View | None = None

    @field_validator("objects", mode="before")
    @classmethod
    def _labels_are_objects(cls, values: Any) -> Any:
        if not isinstance(values, list | tuple) or len(values) > MAX_OBJECTS:
            return values
        return [{"label": value} if isinstance(value, str) else value for value in values]

    @model_validator(mode="after")
    def _makes_a_scene(self) -> Self:
        names = [thing.id or thing.label for thing in self.objects]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"two objects are called {twice[0]!r}: give each an id of its own")
        triples = []
        for relation in self.relations:
            for name in (relation.subject, relation.object):
                if name not in names:
                    raise ValueError(f"a relation names {name!r}, but the scene has no such object")
            subject, other = names.index(relation.subject), names.index(relation.object)
            triples.append(canonicalise(subject, relation.relation, other))
        # A scene refuses contradictions, and a relation of an object to itself.
        Scene(tuple(SceneObject(name, name, None) for name in names), tuple(triples))
        return self


class Example(Frozen):
    """An example scene and its name."""

    name: Word
    scene: ExampleScene

    def request(self) -> dict[str, Any]:
        """Return the scene as the fields of a request, without absent fields."""
        return self.scene.model_dump(mode="json", exclude_defaults=True)

    def require_known(self, vocabulary: Vocabulary) -> None:
        """Check that a vocabulary has all classes and the room type of the scene.

        Raises:
            ValueError: the vocabulary lacks a label or the room type.
        """
        for thing in self.scene.objects:
            if vocabulary.index(thing.label) is None:
                raise ValueError(f"{self.name}: the vocabulary has no class {thing.label!r}")
        room = self.scene.room_type
        if room is not None and vocabulary.room_index(room) is None:
            raise ValueError(f"{self.name}: the vocabulary has no room type {room!r}")


def _are_small(examples: tuple[Example, ...]) -> tuple[Example, ...]:
    size = len(to_json([example.model_dump(mode="json") for example in examples]).encode())
    if size > MAX_EXAMPLES_BYTES:
        raise ValueError(f"the examples have {size} bytes, more than {MAX_EXAMPLES_BYTES}")
    return examples


Examples = Annotated[Many[Example], Field(max_length=MAX_EXAMPLES), AfterValidator(_are_small)]
"""The examples of a model: at most `MAX_EXAMPLES`, of at most `MAX_EXAMPLES_BYTES` together."""
