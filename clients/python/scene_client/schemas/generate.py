"""The contract of `/generate`: what would a scene like this look like?"""

from __future__ import annotations

from typing import Annotated, Final

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError
from typing_extensions import Self

from scene_client.schemas.answers import Answer, Reply
from scene_client.schemas.requests import Finite, Relation, SceneFields, SceneObject, SceneRequest

MAX_SWEEPS: Final = 32_000
"""Maximum number of Gibbs sweeps of one request: number of scenes times sweeps."""


class GenerateRequest(SceneRequest):
    """What would a scene like this look like?"""

    objects: Annotated[list[SceneObject], Field(max_length=256, fail_fast=True)] = []
    """objects in every sampled scene; [] is allowed"""
    count: Annotated[int, Field(ge=1, le=64)] = 1
    """number of scenes to sample"""
    steps: Annotated[int | None, Field(ge=1, le=2000)] = None
    """number of Gibbs sweeps; default: the model's value; `count` times `steps` is at most 32000"""
    # At 2, a scene has 70 objects and 1,000 relations, and 64 scenes take up to 46 s.
    temperature: Annotated[float, Field(ge=0.05, le=1.5, allow_inf_nan=False)] = 1.0
    """sampling temperature, from 0.05 to 1.5; values above 1 give more varied scenes"""

    @model_validator(mode="after")
    def _has_a_limit(self) -> Self:
        if self.count * (self.steps or 1) > MAX_SWEEPS:
            message = f"`count` times `steps` must be at most {MAX_SWEEPS}"
            raise PydanticCustomError("too_many_sweeps", "{message}", {"message": message})
        return self


class GeneratedRelation(Relation):
    """A relation of a sampled scene. `subject` and `object` are labels."""


class GeneratedScene(Reply):
    """A sampled scene: labels of classes, and relations between the labels."""

    room_type: str | None = None
    """room type of the scene; absent if it has none"""
    objects: list[str]
    relations: list[GeneratedRelation]
    log_score: Finite


class GenerateAnswer(Answer):
    """Sampled scenes that contain the given objects.

    The same request with the field `seed` of this answer gives the same scenes.
    """

    seed: int
    scenes: list[GeneratedScene]
    listed_as: dict[str, str] | None = None
    """word of the request for each label of the scenes, if the words differ: the label of the first
    object of the class. Absent if all words equal the labels"""


class GenerateFields(SceneFields, total=False):
    """The fields of `GenerateRequest`."""

    count: int
    steps: int
    temperature: float
