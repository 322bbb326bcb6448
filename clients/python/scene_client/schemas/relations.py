"""The contract of `/relations`: which spatial relations hold between these objects?"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from scene_client.schemas.answers import Answer, ScoredRelation
from scene_client.schemas.requests import (
    Body,
    Id,
    OrArray,
    Probability,
    RelationName,
    Request,
    SceneFields,
    SceneRequest,
    SomeObjects,
)


class Pair(Request):
    """Two objects, each named by its id or an unambiguous label."""

    subject: Id
    object: Id


class RelationsRequest(SceneRequest):
    """Which spatial relations hold between these objects?"""

    objects: SomeObjects
    top_k: Annotated[int, Field(ge=1, le=4096)] = 20
    """maximum number of relations"""
    min_probability: Probability = 0.0
    """minimum probability of the relations in the answer"""
    pairs: Annotated[
        list[Annotated[Pair, OrArray()]] | None,
        Field(min_length=1, max_length=4096, fail_fast=True),
    ] = None
    """limit the answer to these pairs of subject and object"""
    include_opposites: bool = False
    """also list right, behind, under, below and contains. Without opposites and `pairs`, under may
    replace the opposite on-top where it is the usual word: a chair under a table"""


@dataclass(slots=True)
class Disagreement:
    """Two objects whose observed relation differs from the expected relation.

    `subject` and `object` are ids. `observed` lists the stated or derived relations between the two
    objects. `expected` is their most probable relation given the rest of the scene, without the
    observed relations of the two objects. `probability` is the probability of `expected`.
    `observed_probability` is the probability of the most probable observed relation.
    """

    # `Disagreement` is a dataclass for speed, because an answer may contain many disagreements.
    subject: str
    object: str
    observed: list[RelationName]
    expected: RelationName
    probability: Probability
    observed_probability: Probability


class ExpectedRelation(ScoredRelation):
    """A relation and the probability that it holds, given that both objects are in the scene.

    For an observed relation, `probability` is that of the evidence: the product of the confidences
    of both objects, and of the probability of the relation under the errors of their boxes. A
    relation that the boxes of both objects exclude has at most .01.
    """

    observed: bool = False
    """true if the request states the relation, or if the boxes show it with a probability of at
    least .5"""
    expected: Probability | None = None
    """for an observed relation: its probability if it were not observed"""


class RelationsAnswer(Answer):
    """Relations between the objects, most probable relation first.

    `probability` is the probability that the relation holds, given that both objects are in the
    scene.
    """

    relations: list[ExpectedRelation]
    disagreements: list[Disagreement]
    """pairs whose observed relation differs from the expected relation, at most `top_k`. Given the
    rest of the scene, the expected relation has a probability of at least one half. The first pair
    has the largest ratio of the probabilities of the expected and the observed relation"""


class RelationsFields(SceneFields, total=False):
    """The fields of `RelationsRequest`."""

    top_k: int
    min_probability: float
    pairs: Iterable[Pair | Body | tuple[str, str]]
    include_opposites: bool
