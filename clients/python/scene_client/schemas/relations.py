"""The contract of `/relations`: how do these objects stand to each other?"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from scene_client.schemas.answers import Answer, ScoredRelation
from scene_client.schemas.requests import (
    Body,
    Name,
    Probability,
    RelationName,
    Request,
    SceneFields,
    SceneRequest,
    SomeObjects,
)


class Pair(Request):
    """Two objects, each named by its id or an unambiguous label."""

    subject: Name
    object: Name


class RelationsOptions(Request):
    """Options of `/relations`, besides the scene."""

    top_k: Annotated[int, Field(ge=1, le=4096, description="maximum number of relations")] = 20
    min_probability: Annotated[
        Probability, Field(description="leave out relations with a lower probability")
    ] = 0.0
    pairs: Annotated[
        list[Pair] | None,
        Field(
            min_length=1,
            max_length=4096,
            fail_fast=True,
            description="only relations of these ordered pairs",
        ),
    ] = None
    include_opposites: Annotated[
        bool, Field(description="also list right, behind, under and below")
    ] = False


class RelationsRequest(RelationsOptions, SceneRequest):
    """How do these objects stand to each other?"""

    objects: SomeObjects


@dataclass(slots=True)
class Disagreement:
    """Two objects (by id) whose observed relation differs from the expected one.

    `observed`: stated or derived relations of `subject` to `object`. `expected`: the likeliest
    relation given the rest of the scene, without any observed relation of the two objects.
    `probability`: probability of `expected`. `observed_probability`: probability of the likeliest
    observed relation.
    """

    # A dataclass too, because half of the observed relations may appear here.
    subject: str
    object: str
    observed: list[RelationName]
    expected: RelationName
    probability: Probability
    observed_probability: Probability


class ExpectedRelation(ScoredRelation):
    """A relation and the probability that it holds, given that both objects are in the scene."""

    observed: Annotated[
        bool, Field(description="the request states the relation, or positions show it")
    ] = False


class RelationsAnswer(Answer):
    """Relations, best first.

    `probability`: the relation holds between the two objects, given that both are in the scene.
    """

    relations: list[ExpectedRelation]
    disagreements: Annotated[
        list[Disagreement],
        Field(
            description="pairs whose stated or derived relation differs from the expected one. The "
            "expected relation has a probability of at least one half given the rest of the scene. "
            "Largest ratio of the probabilities first, at most `top_k`"
        ),
    ]


class RelationsFields(SceneFields, total=False):
    """The fields of `RelationsRequest`."""

    top_k: int
    min_probability: float
    pairs: Iterable[Pair | Body | tuple[str, str]]
    include_opposites: bool
