"""Descriptions of the served models, for the routes under ``/models``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import cast

from app.registry import AliasTarget
from app.scene.relations import opposite
from app.serving.models import ServedModel, ServedModels
from scene_client import schemas


def everything(models: ServedModels) -> schemas.ModelList:
    """List all models, versions, aliases and failures."""
    return schemas.ModelList(
        generation=models.generation,
        models=[_summary(models, name) for name in models.store.versions],
        aliases={alias: str(target) for alias, target in sorted(models.store.aliases.items())},
        failures=list(models.failures.values()),
    )


def model(models: ServedModels, reference: str) -> schemas.ModelSummary:
    """Describe the model with a name or an alias, even if the service refused all its versions.

    Raises:
        UnknownModelError: no model or alias has the name ``reference``.
    """
    return _summary(models, _name(models, reference))


def version(models: ServedModels, reference: str, number: str) -> schemas.VersionDetails:
    """Describe one version of the model with a name or an alias.

    Raises:
        UnknownModelError: no model or alias has the name ``reference``, or the model does not have
            the version ``number``.
    """
    name = _name(models, reference)
    if number not in models.store.versions[name]:
        raise models.unknown(f"{name}@{number}")
    summary = _version_summary(models, name, number)
    served = models.served.get((name, number))
    if served is None:
        return schemas.VersionDetails(name=name, **dict(summary))
    manifest = served.artifact.manifest
    return schemas.VersionDetails(
        name=name,
        **dict(summary),
        created=manifest.created,
        parameters=sum(math.prod(tensor.shape) for tensor in manifest.weights.values()),
        metrics=[schemas.Metric(**metric.model_dump()) for metric in manifest.metrics],
        data=[schemas.TrainingSource(**source.model_dump()) for source in manifest.data],
        terms=manifest.terms,
        card=served.artifact.card,
    )


def vocabulary(served: ServedModel) -> schemas.VocabularyAnswer:
    """List the object classes, relations and room types of a model."""
    canonical = served.artifact.manifest.vocabulary.relations
    names = (*canonical, *map(opposite, canonical))
    return schemas.VocabularyAnswer(
        model=served.reference,
        objects=[
            schemas.VocabularyEntry(
                label=entry.label,
                aliases=list(entry.aliases),
                structure=entry.structure,
                size=_size(entry.size),
            )
            for entry in served.vocabulary.objects
        ],
        relations=[cast("schemas.RelationName", name) for name in names],
        room_types=list(served.vocabulary.room_types),
        examples=[
            schemas.ExampleScene(name=example.name, scene=example.request())
            for example in served.artifact.manifest.examples
        ],
    )


def contexts(served: ServedModel) -> schemas.ContextsAnswer:
    """List the hidden units of a model with the objects and relations of their largest weights."""
    return schemas.ContextsAnswer(model=served.reference, layers=dict(served.contexts))


def _size(extents: Sequence[float] | None) -> schemas.Size | None:
    return None if extents is None else schemas.Size(**dict(zip("xyz", extents, strict=True)))


def _name(models: ServedModels, reference: str) -> str:
    """Return the model name of a reference, even if the service refused the version."""
    name = reference.partition("@")[0]
    target: AliasTarget | None = models.store.aliases.get(name)
    if target is not None:
        name = target.name
    if name not in models.store.versions:
        raise models.unknown(reference)
    return name


def _summary(models: ServedModels, name: str) -> schemas.ModelSummary:
    return schemas.ModelSummary(
        name=name,
        versions=[
            _version_summary(models, name, number)
            for number in reversed(models.store.versions[name])
        ],
    )


def _version_summary(models: ServedModels, name: str, number: str) -> schemas.VersionSummary:
    served = models.served.get((name, number))
    if served is None:
        failure = models.failures[f"{name}@{number}"]
        return schemas.VersionSummary(
            version=number,
            status="refused",
            aliases=[],
            reason=failure.reason,
            detail=failure.detail,
        )
    return schemas.VersionSummary(
        version=number,
        status="ready",
        aliases=models.aliases[name, number],
        variant=served.reference.variant,
        digest=served.reference.digest,
    )
