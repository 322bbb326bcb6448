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
    """Two objects, each by its id or an unambiguous label."""

    subject: Name
    object: Name


class RelationsOptions(Request):
    """What `/relations` is asked beside the scene."""

    top_k: Annotated[int, Field(ge=1, le=4096, description="how many relations at most")] = 20
    min_probability: Annotated[Probability, Field(description="leave out what is less likely")] = (
        0.0
    )
    pairs: Annotated[
        list[Pair] | None,
        Field(
            min_length=1, max_length=4096, fail_fast=True, description="only these ordered pairs"
        ),
    ] = None
    include_opposites: Annotated[
        bool, Field(description="also report right, behind, under and below")
    ] = False


class RelationsRequest(RelationsOptions, SceneRequest):
    """How do these objects stand to each other?"""

    objects: SomeObjects


@dataclass(slots=True)
class Disagreement:
    """Two objects (by id) that stand otherwise than the rest of the scene makes one expect.

    `observed`: relations of `subject` to `object` that were stated or derived. `expected`: the
    likeliest relation without all that is known of how the two stand, with its `probability`;
    `observed_probability`: of the likeliest observed one.
    """

    # No model either: half of the observed relations may be in it.
    subject: str
    object: str
    observed: list[RelationName]
    expected: RelationName
    probability: Probability
    observed_probability: Probability


class ExpectedRelation(ScoredRelation):
    """A relation and the probability that it holds, given that both objects are in the scene."""

    observed: Annotated[bool, Field(description="the request states it, or positions show it")] = (
        False
    )


class RelationsAnswer(Answer):
    """Relations, best first.

    `probability`: the relation holds between the two, given that both are in the scene.
    """

    relations: list[ExpectedRelation]
    disagreements: Annotated[
        list[Disagreement],
        Field(
            description="where another relation than what was stated or observed is expected: "
            "from the rest of the scene alone it has a probability of at least one half; largest "
            "ratio of the probabilities first, at most `top_k`"
        ),
    ]


class RelationsFields(SceneFields, total=False):
    """The fields of `RelationsRequest`."""

    top_k: int
    min_probability: float
    pairs: Iterable[Pair | Body | tuple[str, str]]
    include_opposites: bool
