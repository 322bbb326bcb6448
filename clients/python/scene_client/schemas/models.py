"""Answers about models, and about the health of the service."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field

from scene_client.schemas.answers import Failure, ModelReference, Reply
from scene_client.schemas.requests import Finite, RelationName, Size

# ------------------------------------------------------------------------------------ models


class Metric(Reply):
    """A metric measured on held-out scenes, with its 95 % interval over n units."""

    task: str
    source: str
    metric: str
    value: Finite
    low: Finite
    high: Finite
    n: int


class TrainingSource(Reply):
    """Scenes on which a model was trained, and their terms of use."""

    source: str
    scenes: int
    digest: str
    terms: str
    research_only: bool


class VersionSummary(Reply):
    """One version of a model; it is ready, or refused for a reason."""

    version: str
    status: Literal["ready", "refused"]
    aliases: Annotated[list[str], Field(description="aliases that point at this version")]
    variant: str | None = None
    digest: str | None = None
    reason: Annotated[
        str | None, Field(description="stable code of the reason for the refusal")
    ] = None
    detail: Annotated[str | None, Field(description="the reason in words")] = None


class ModelSummary(Reply):
    """A model and its versions, newest first."""

    name: str
    versions: list[VersionSummary]


class ModelList(Reply):
    """The models of the service, and its aliases."""

    models: list[ModelSummary]
    aliases: Annotated[
        dict[str, str],
        Field(description="target of each alias: `name@version`, or `name` (newest)"),
    ]
    failures: Annotated[
        list[Failure], Field(description="entries of the store that cannot be used, with reasons")
    ] = []
    generation: Annotated[
        str,
        Field(description="equal in all replicas with the same versions and aliases"),
    ] = ""


class VersionDetails(VersionSummary):
    """The details of one version; a refused version has only its summary."""

    name: str
    created: datetime | None = None
    parameters: Annotated[int | None, Field(description="number of weights")] = None
    metrics: list[Metric] = []
    data: Annotated[list[TrainingSource], Field(description="sources of the training scenes")] = []
    terms: Annotated[str | None, Field(description="licence of the weights")] = None
    card: Annotated[str | None, Field(description="the model card, in Markdown")] = None


class VocabularyEntry(Reply):
    """One class of objects. Structure classes (walls, floors, vague names) are never proposed."""

    label: str
    aliases: list[str]
    structure: bool
    size: Annotated[
        Size | None,
        Field(description="typical extents in metres, used if a detection has no size"),
    ] = None


class VocabularyAnswer(Reply):
    """The vocabulary of a model. Case, separators and plurals never matter."""

    model: ModelReference
    objects: list[VocabularyEntry]
    relations: list[RelationName]
    room_types: list[str]


class WeightedLabel(Reply):
    """An object class or room type, and its weight to a hidden unit."""

    label: str
    weight: Finite


class WeightedRelation(Reply):
    """A relation between two classes and its weight to a hidden unit."""

    subject: str
    relation: RelationName
    object: str
    weight: Finite


class ContextUnit(Reply):
    """A hidden unit with its objects, relations and room types, strongest first."""

    unit: int
    name: Annotated[str, Field(description="readable name: its strongest objects and relation")]
    objects: list[WeightedLabel]
    relations: Annotated[
        list[WeightedRelation],
        Field(
            description="relations seen in training; each weight is the difference from the mean "
            "over the layer"
        ),
    ]
    room_types: list[WeightedLabel]


class ContextsAnswer(Reply):
    """The hidden units of a model, layer by layer."""

    model: ModelReference
    layers: dict[str, list[ContextUnit]]


class RefreshAnswer(Reply):
    """The changes made by a refresh."""

    request_id: str
    default: Annotated[ModelReference, Field(description="the model at which `default` points")]
    added: Annotated[list[str], Field(description="versions that are new, as `name@version`")]
    removed: Annotated[
        list[str], Field(description="versions that no longer answer, as `name@version`")
    ]
    failures: Annotated[
        list[Failure], Field(description="entries of the store that failed before and still fail")
    ] = []


class AliasAnswer(Reply):
    """The new and the previous target of an alias."""

    request_id: str
    alias: str
    model: str
    previous: str | None = None


# ------------------------------------------------------------------------------------ health


class Health(Reply):
    """The status of the service."""

    status: Literal["live", "ready"]


class ServerMetadata(Reply):
    """Open Inference Protocol: metadata of the server."""

    name: str
    version: str
    extensions: list[str]


class ServerLive(Reply):
    """Open Inference Protocol: the process answers."""

    live: bool


class ServerReady(Reply):
    """Open Inference Protocol: the default model is ready."""

    ready: bool


class ModelReady(Reply):
    """Open Inference Protocol: this model is ready."""

    name: str
    ready: bool


class TensorMetadata(Reply):
    """Open Inference Protocol: metadata of a tensor; the questions of this service use none."""

    name: str
    datatype: str
    shape: list[int]


class ModelMetadata(Reply):
    """Open Inference Protocol: metadata of a model. Its questions are `/relations` and similar."""

    name: str
    versions: list[str]
    platform: str
    inputs: list[TensorMetadata] = []
    outputs: list[TensorMetadata] = []
