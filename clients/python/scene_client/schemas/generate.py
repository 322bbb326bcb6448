"""The contract of `/generate`: what would a scene like this look like?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

from pydantic import Field

from scene_client.schemas.answers import Answer, Reply
from scene_client.schemas.requests import (
    Finite,
    Name,
    Relation,
    SceneFields,
    SceneObject,
    SceneRequest,
    UnitNumber,
)


class GenerateRequest(SceneRequest):
    """What would a scene like this look like?"""

    objects: Annotated[
        list[SceneObject],
        Field(max_length=256, description="objects that every scene contains; may be empty"),
    ] = []
    count: Annotated[int, Field(ge=1, le=64, description="number of scenes")] = 1
    steps: Annotated[
        int | None,
        Field(ge=1, le=2000, description="number of Gibbs sweeps; default: the model's own"),
    ] = None
    temperature: Annotated[
        float,
        Field(
            ge=0.05,
            le=20,
            allow_inf_nan=False,
            description="sampling temperature; above 1: more varied scenes",
        ),
    ] = 1.0
    context: Annotated[
        dict[Name, Annotated[list[UnitNumber], Field(max_length=4096)]] | None,
        Field(max_length=8, description="numbers of the active units, by the name of the layer"),
    ] = None


class GeneratedScene(Reply):
    """A sampled scene: labels, relations between labels, and the active context units."""

    objects: list[str]
    relations: list[Relation]
    log_score: Finite
    context: Annotated[
        dict[str, list[int]],
        Field(description="numbers of the active units, by the name of the layer"),
    ]


class GenerateAnswer(Answer):
    """Scenes that contain the given objects; an equal `seed` gives equal scenes."""

    seed: int
    scenes: list[GeneratedScene]


class GenerateFields(SceneFields, total=False):
    """The fields of `GenerateRequest`."""

    count: int
    steps: int
    temperature: float
    context: Mapping[str, Sequence[int]]
