"""Warm-up of models: each verified model answers every question before the service uses it."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from types import MappingProxyType

from app.questions import QUESTIONS
from app.questions.answer import written
from app.registry import Artifact, ArtifactFailure, ModelSet
from app.scene.scene import Scene, SceneObject, observe
from app.scene.vocabulary import Vocabulary
from app.serving.admission import WorkQueue
from app.serving.models import Key, ServedModel, ServedModels

_logger = logging.getLogger("app.serving")


def prepare(
    store: ModelSet, new_queue: Callable[[], WorkQueue], previous: ServedModels
) -> ServedModels:
    """Warm up every verified model. Return the models that can be served, and all failures.

    If ``previous`` already serves a model from the same artifact, the function skips the warm-up of
    this model and keeps its queue.
    """
    served: dict[Key, ServedModel] = {}
    entries = dict(store.entries)
    for key, artifact in store.entries.items():
        if not isinstance(artifact, Artifact):
            continue
        before = previous.served.get(key)
        if before is not None and before.artifact is artifact:
            served[key] = before
            continue
        try:
            warm_up(artifact)
        except Exception:
            # A broken model may raise any exception. The service must still serve other models.
            _logger.exception("the warm-up of model %s failed", "@".join(key))
            entries[key] = ArtifactFailure(
                "warm_up_failed", "the files are valid, but the model could not answer a question"
            )
        else:
            served[key] = ServedModel(artifact, new_queue())
    return ServedModels(replace(store, entries=MappingProxyType(entries)), MappingProxyType(served))


def warm_up(artifact: Artifact) -> None:
    """Ask each question about three scenes: with relations, without relations, and with poses.

    Raises:
        ValueError: an answer contains a number that is not finite.
        Exception: any other error of the model.
    """
    related = _scene(artifact.vocabulary)
    bare = replace(related, relations=None)
    posed = observe(bare, typical_sizes=artifact.vocabulary.sizes)
    scenes = related, bare, posed
    for question in QUESTIONS:
        for answer in question.warm_up(artifact, scenes):
            written(answer)


def _scene(vocabulary: Vocabulary) -> Scene:
    """Return a scene of up to three objects in a row. The third object is on top of the second."""
    proposable = [i for i, entry in enumerate(vocabulary.objects) if not entry.structure]
    objects = tuple(
        SceneObject(str(place), vocabulary.labels[index], index, position=(1.0, 0.5 * place, 0.5))
        for place, index in enumerate((proposable or [0])[:3])
    )
    return Scene(objects, ((2, 1, 0),) if len(objects) > 1 else None)
