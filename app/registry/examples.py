"""Example scenes of a model, for the visual page. The manifest contains them."""

from __future__ import annotations

from typing import Annotated, Any, Final

from pydantic import AfterValidator, BeforeValidator, Field, field_serializer, field_validator

from app.registry.fields import Frozen, Many, to_json
from app.scene.relations import canonicalise
from app.scene.scene import Scene, SceneObject
from app.scene.vocabulary import Vocabulary
from scene_client.schemas import Label, SceneRequest

MAX_EXAMPLES: Final = 8
MAX_WORD: Final = 100
MAX_EXAMPLES_BYTES: Final = 32_768
"""Maximum size of all examples of a model as JSON, in bytes."""
_FIELDS: Final = frozenset({"objects", "relations", "room_type", "frame_id", "viewpoint"})


def _compact(value: Any) -> Any:
    """Remove absent and empty fields, and make each label an object."""
    if isinstance(value, dict):
        return {name: _compact(part) for name, part in value.items() if part not in (None, [])}
    if isinstance(value, list):
        return [{"label": part} if isinstance(part, str) else _compact(part) for part in value]
    return value


class Example(Frozen):
    """An example scene, as the fields of a request to the service, and its name.

    Raises:
        ValueError: two objects have the same name, a relation names no object of the scene, or two
            relations contradict each other. The name of an object is its id, or its label if it has
            no id.
    """

    name: Label
    scene: Annotated[SceneRequest, BeforeValidator(_compact)]

    @field_validator("scene")
    @classmethod
    def _makes_a_scene(cls, scene: SceneRequest) -> SceneRequest:
        if extra := sorted(scene.model_fields_set - _FIELDS):
            raise ValueError(f"an example must not have the field {extra[0]!r}")
        names = [
            thing if isinstance(thing, str) else thing.id or thing.label for thing in scene.objects
        ]
        if doubles := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"two objects are called {doubles[0]!r}: give each an id of its own")
        triples = []
        for relation in scene.relations or ():
            for name in (relation.subject, relation.object):
                if name not in names:
                    raise ValueError(f"a relation names {name!r}, but the scene has no such object")
            subject, other = names.index(relation.subject), names.index(relation.object)
            triples.append(canonicalise(subject, relation.relation, other))
        # A scene refuses contradictions, and a relation of an object to itself.
        Scene(tuple(SceneObject(name, name, None) for name in names), tuple(triples))
        return scene

    @field_serializer("scene")
    def _without_defaults(self, scene: SceneRequest) -> dict[str, Any]:
        return scene.model_dump(mode="json", exclude_defaults=True)

    def request(self) -> dict[str, Any]:
        """Return the scene as the fields of a request, without absent fields."""
        return self._without_defaults(self.scene)

    def require_known(self, vocabulary: Vocabulary) -> None:
        """Check that a vocabulary has all classes and the room type of the scene.

        Raises:
            ValueError: the vocabulary lacks a label or the room type.
        """
        for thing in self.request()["objects"]:
            if vocabulary.index(thing["label"]) is None:
                raise ValueError(f"{self.name}: the vocabulary has no class {thing['label']!r}")
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
