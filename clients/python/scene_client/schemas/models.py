"""Answers about models, and about the health of the service."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field

from scene_client.schemas.answers import Failure, ModelReference, Reply
from scene_client.schemas.requests import Finite, RelationName, Size

# ------------------------------------------------------------------------------------ models


class Metric(Reply):
    """One figure measured on held-out scenes, with its 95 % interval over n units."""

    task: str
    source: str
    metric: str
    value: Finite
    low: Finite
    high: Finite
    n: int


class TrainingSource(Reply):
    """Scenes that a model was trained on, and their terms."""

    source: str
    scenes: int
    digest: str
    terms: str
    research_only: bool


class VersionSummary(Reply):
    """One version of a model: usable, or refused with the reason."""

    version: str
    status: Literal["ready", "refused"]
    aliases: Annotated[list[str], Field(description="aliases that lead to this version")]
    variant: str | None = None
    digest: str | None = None
    reason: Annotated[str | None, Field(description="why it was refused: a stable code")] = None
    detail: Annotated[str | None, Field(description="the same in words")] = None


class ModelSummary(Reply):
    """A model and its versions, newest first."""

    name: str
    versions: list[VersionSummary]


class ModelList(Reply):
    """What the service has, and the aliases that lead to it."""

    models: list[ModelSummary]
    aliases: Annotated[
        dict[str, str], Field(description="alias to `name@version`, or to `name` for its newest")
    ]
    failures: Annotated[
        list[Failure], Field(description="what of the store cannot be used, and why")
    ] = []
    generation: Annotated[
        str,
        Field(description="the same in all replicas that serve the same versions and aliases"),
    ] = ""


class VersionDetails(VersionSummary):
    """All there is to know about one version; a refused one has no more than its summary."""

    name: str
    created: datetime | None = None
    parameters: Annotated[int | None, Field(description="how many weights it has")] = None
    metrics: list[Metric] = []
    data: Annotated[list[TrainingSource], Field(description="what it was trained on")] = []
    terms: Annotated[str | None, Field(description="licence of the weights")] = None
    card: Annotated[str | None, Field(description="the model card, in Markdown")] = None


class VocabularyEntry(Reply):
    """One class of objects. Structure (walls, floors, vague names) is accepted, never proposed."""

    label: str
    aliases: list[str]
    structure: bool
    size: Annotated[
        Size | None,
        Field(description="typical extents in metres, taken where a detection brings none"),
    ] = None


class VocabularyAnswer(Reply):
    """The words of a model. Case, separators and plurals never matter."""

    model: ModelReference
    objects: list[VocabularyEntry]
    relations: list[RelationName]
    room_types: list[str]


class WeightedLabel(Reply):
    """An object or room type and its weight to a hidden unit."""

    label: str
    weight: Finite


class WeightedRelation(Reply):
    """A relation between two classes and its weight to a hidden unit."""

    subject: str
    relation: RelationName
    object: str
    weight: Finite


class ContextUnit(Reply):
    """A hidden unit by the objects, relations and room types it goes with, strongest first."""

    unit: int
    name: Annotated[str, Field(description="its first objects and relation, for people to read")]
    objects: list[WeightedLabel]
    relations: Annotated[
        list[WeightedRelation],
        Field(
            description="of those that the model saw in training; their weights are beyond the "
            "mean over the layer"
        ),
    ]
    room_types: list[WeightedLabel]


class ContextsAnswer(Reply):
    """The hidden units of a model, layer by layer."""

    model: ModelReference
    layers: dict[str, list[ContextUnit]]


class RefreshAnswer(Reply):
    """What a refresh changed."""

    request_id: str
    default: Annotated[ModelReference, Field(description="the model that `default` leads to")]
    added: Annotated[list[str], Field(description="`name@version` that now answer and did not")]
    removed: Annotated[list[str], Field(description="`name@version` that no longer answer")]
    failures: Annotated[
        list[Failure], Field(description="what could not be used before, and still cannot")
    ] = []


class AliasAnswer(Reply):
    """Where an alias leads now, and where it led before."""

    request_id: str
    alias: str
    model: str
    previous: str | None = None


# ------------------------------------------------------------------------------------ health


class Health(Reply):
    """The service's own spelling of health."""

    status: Literal["live", "ready"]


class ServerMetadata(Reply):
    """Open Inference Protocol: the server."""

    name: str
    version: str
    extensions: list[str]


class ServerLive(Reply):
    """Open Inference Protocol: the process answers."""

    live: bool


class ServerReady(Reply):
    """Open Inference Protocol: the default model answers."""

    ready: bool


class ModelReady(Reply):
    """Open Inference Protocol: this model answers."""

    name: str
    ready: bool


class TensorMetadata(Reply):
    """Open Inference Protocol: a tensor. The questions of this service are not put in tensors."""

    name: str
    datatype: str
    shape: list[int]


class ModelMetadata(Reply):
    """Open Inference Protocol: a model. It is asked through `/relations` and its siblings."""

    name: str
    versions: list[str]
    platform: str
    inputs: list[TensorMetadata] = []
    outputs: list[TensorMetadata] = []
