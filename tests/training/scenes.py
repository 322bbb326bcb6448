"""Annotated scenes of a few objects."""

from typing import Any

from app.model import SceneModel
from app.scene import RoleCounts, Scene, SceneObject, Vocabulary
from training.datasets import AnnotatedObject, AnnotatedScene, EncodedScene, encode


def things(*labels: str, **attributes: list[Any]) -> tuple[AnnotatedObject, ...]:
    """Objects of labels, numbered in order. `attributes` has a list of values for each name."""
    return tuple(
        AnnotatedObject(str(k), label, **{key: values[k] for key, values in attributes.items()})
        for k, label in enumerate(labels)
    )


def scene(name: str, *labels: str, relations=None, group=None, room=None, **attributes):
    """A scene of `things`, with relations (position, relation, position)."""
    objects, triples = things(*labels, **attributes), None if relations is None else (*relations,)
    return AnnotatedScene(name, "test", group or name, room, objects, triples)


def encode_objects(
    objects: tuple[AnnotatedObject, ...],
    vocabulary: Vocabulary,
    roles: RoleCounts | None = None,
    **fields: Any,
) -> EncodedScene:
    """Encode a scene of objects. `fields` has other fields of the scene than the default ones."""
    values: dict[str, Any] = {"scene_id": "s", "source": "t", "group": "g", "room_type": None}
    one = AnnotatedScene(**values | {"objects": objects} | fields)
    return encode([one], vocabulary, roles)[0]


def request(model: SceneModel, *labels: str, room: str | None = None) -> Scene:
    """The scene of a request with labels of the model."""
    words = model.vocabulary
    objects = tuple(SceneObject(label, label, words.index(label)) for label in labels)
    return Scene(objects, room_type=None if room is None else words.room_index(room))
