"""What a question may be given: the fields of the requests, with short forms for common ones."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias, TypedDict

from scene_client.schemas import (
    Anchor,
    Detection,
    Pair,
    Relation,
    RelationName,
    Sensitivity,
    Stamp,
    UnknownLabels,
    Viewpoint,
)

Body: TypeAlias = Mapping[str, Any]
"""Any part of a request, as in the HTTP contract."""

Objects: TypeAlias = Iterable[str | Detection | Body]
"""Labels, detections, or detections as in the HTTP contract."""


class SceneFields(TypedDict, total=False):
    """The fields of `SceneRequest`; relations and pairs may be plain tuples of names."""

    relations: Iterable[Relation | Body | tuple[str, RelationName, str]]
    relations_complete: bool
    room_type: str
    frame_id: str
    stamp: Stamp | Body
    viewpoint: Viewpoint | Body
    model: str
    seed: int
    unknown_labels: UnknownLabels


class RelationsFields(SceneFields, total=False):
    """The fields of `RelationsRequest`."""

    top_k: int
    min_probability: float
    pairs: Iterable[Pair | Body | tuple[str, str]]
    include_opposites: bool


class MissingFields(SceneFields, total=False):
    """The fields of `MissingRequest`; ``at`` may be ``("on-top", "desk")``."""

    coverage: float
    top_k: int
    candidates: Iterable[str]
    at: Anchor | Body | tuple[RelationName, str]


class OutliersFields(SceneFields, total=False):
    """The fields of `OutliersRequest`."""

    sensitivity: Sensitivity
    threshold: float


class GenerateFields(SceneFields, total=False):
    """The fields of `GenerateRequest`."""

    count: int
    steps: int
    temperature: float
    context: Mapping[str, Sequence[int]]


class AliasFields(TypedDict, total=False):
    """The fields of `AliasRequest` beside the model."""

    expected: str | None
