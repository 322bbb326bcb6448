"""Schemas of the answers about models, and about the health of the service."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field

from scene_client.schemas.answers import Failure, ModelReference, Reply, Rule
from scene_client.schemas.requests import Finite, RelationName, Size

# ------------------------------------------------------------------------------------ models


class Metric(Reply):
    """A metric on held-out scenes, with its 95 % confidence interval. `n` is the sample size."""

    task: str
    source: str
    metric: str
    value: Finite
    low: Finite
    high: Finite
    n: int


class TrainingSource(Reply):
    """A source of training scenes and its terms of use."""

    source: str
    scenes: int
    digest: str
    terms: str
    research_only: bool


class VersionSummary(Reply):
    """One version of a model. If the service refused the version, `reason` is its code."""

    version: str
    status: Literal["ready", "refused"]
    aliases: list[str]
    """aliases that point at this version"""
    variant: str | None = None
    digest: str | None = None
    reason: str | None = None
    """stable code of the reason for the refusal"""
    detail: str | None = None
    """the reason for the refusal in words"""


class ModelSummary(Reply):
    """A model and its versions, newest first."""

    name: str
    versions: list[VersionSummary]


class ModelList(Reply):
    """The models and the aliases of the service."""

    models: list[ModelSummary]
    aliases: dict[str, str]
    """target of each alias: `name@version`, or `name` for the newest usable version"""
    failures: list[Failure] = []
    """unusable entries of the store, with reasons"""
    generation: str = ""
    """digest of all versions and aliases; equal for replicas of equal state"""


class VersionDetails(VersionSummary):
    """The details of one version. A refused version has only the fields of `VersionSummary`."""

    name: str
    created: datetime | None = None
    parameters: int | None = None
    """number of weights"""
    metrics: list[Metric] = []
    data: list[TrainingSource] = []
    """sources of the training scenes"""
    terms: str | None = None
    """terms of use of the weights"""
    card: str | None = None
    """the model card, in Markdown"""


class VocabularyEntry(Reply):
    """One object class. Models never propose a class with `structure`, such as wall or floor."""

    label: str
    aliases: list[str]
    structure: bool
    size: Size | None = None
    """typical extents in metres, for detections without a size"""
    parent: str | None = None
    """label of the broader class, such as lamp for floor lamp"""
    anywhere: bool = False
    """true if objects of the class belong in every room: pets, people, bags, toys"""
    hangs: bool = False
    """true if most objects of the class hang on a wall or from the ceiling"""


class ExampleScene(Reply):
    """An example scene of the model, for `client.missing(example.scene)`."""

    name: str
    scene: dict[str, Any]
    """fields of a request: objects and optionally relations, room_type, frame_id and viewpoint"""


class VocabularyAnswer(Reply):
    """The vocabulary of a model. Letter case, separators and plurals of labels do not matter."""

    model: ModelReference
    objects: list[VocabularyEntry]
    relations: list[RelationName]
    room_types: list[str]
    rare_room_types: list[str] = []
    """room types that `/generate` refuses, because too few training scenes have them"""
    written_room_types: list[str] = []
    """room types that the model knows from written descriptions alone, not from real rooms"""
    profiles: list[str] = []
    """names of the data sources whose base rates a request can choose"""
    examples: list[ExampleScene] = []
    """example scenes; older models have none"""


class WordAnswer(Reply):
    """The class that a label becomes, or similar classes if the model does not know the label."""

    model_config = ConfigDict(frozen=True, populate_by_name=True, serialize_by_alias=True)

    model: ModelReference
    word: str
    class_: Annotated[VocabularyEntry | None, Field(alias="class")] = None
    rule: Literal["label"] | Rule | None = None
    """how the service reads the label: `label` of the vocabulary, or a rule of `mapped`"""
    certain: bool = False
    """true if every request accepts the label; false if it needs `unknown_labels: nearest`"""
    suggestions: list[str] = []
    """classes with similar names, if the model does not know the label"""


# ------------------------------------------------------------------------------------ health


class Health(Reply):
    """The status of the service."""

    status: Literal["live", "ready"]
    version: str | None = None
    """version of the service, in liveness checks"""
    failures: list[Failure] | None = None
    """in readiness checks, up to 10 unusable entries of the store; `GET /models` lists all"""
