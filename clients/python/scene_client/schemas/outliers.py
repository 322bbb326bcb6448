"""The contract of `/outliers`: what does not belong here, or stands in the wrong place?"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from scene_client.schemas.answers import Answer, Because, Reply, ScoredRelation
from scene_client.schemas.requests import (
    Finite,
    Probability,
    Request,
    SceneFields,
    SceneRequest,
    SomeObjects,
)

Sensitivity = Literal["low", "medium", "high"]


class OutliersOptions(Request):
    """Options of `/outliers`, besides the scene."""

    sensitivity: Annotated[
        Sensitivity,
        Field(
            description="alarm rate: about 2, 10 or 20 % of untouched scenes of the hardest large "
            "source raise an alarm. The same rates hold for lists of few classes"
        ),
    ] = "medium"
    threshold: Annotated[
        Probability | None,
        Field(
            description="an object is an outlier from this probability on; default: the model's "
            "threshold for `sensitivity`",
        ),
    ] = None


class OutliersRequest(OutliersOptions, SceneRequest):
    """What does not belong here, or stands in the wrong place?"""

    objects: SomeObjects


class Outlier(Reply):
    """How well one object fits the scene.

    `probability`: the object does not belong, if half of all scenes contain an intruder.
    `log_odds`: log-odds that its class is present, given the rest of the scene.
    """

    object: str
    label: str
    probability: Probability
    log_odds: Finite
    is_outlier: bool
    because: Annotated[
        list[Because],
        Field(
            description="objects that support the verdict, strongest first, at most 3. For an "
            "outlier, they make the object unlikely; for any other object, they make it likely"
        ),
    ]
    usually_with: Annotated[
        list[str],
        Field(description="for an outlier: absent classes that would make it likely, at most 3"),
    ] = []


class MisplacedRelation(ScoredRelation):
    """A relation as the request spells it, and the probability that it is false."""

    is_misplaced: Annotated[
        bool, Field(description="true if `probability` reaches the threshold of `sensitivity`")
    ] = False


class OutliersAnswer(Answer):
    """Objects, least fitting first, and stated or derived relations, least likely first.

    In `misplaced`, `probability` means that the relation is false.
    """

    threshold: Annotated[
        Probability | None,
        Field(description="applied probability from which an object is an outlier"),
    ] = None
    outliers: list[Outlier]
    misplaced: list[MisplacedRelation]


class OutliersFields(SceneFields, total=False):
    """The fields of `OutliersRequest`."""

    sensitivity: Sensitivity
    threshold: float
