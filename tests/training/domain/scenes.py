"""Annotated scenes in a line."""

from __future__ import annotations

from training.datasets import AnnotatedObject, AnnotatedScene


def scene(name: str, *labels: str, relations=None, group=None, room=None, **things):
    """A scene of labels, numbered as they come; relations as (position, relation, position).

    Args:
        things: attributes of all objects by name, each a list.
    """
    objects = tuple(
        AnnotatedObject(str(k), label, **{key: values[k] for key, values in things.items()})
        for k, label in enumerate(labels)
    )
    triples = None if relations is None else tuple(relations)
    return AnnotatedScene(name, "test", group or name, room, objects, triples)
