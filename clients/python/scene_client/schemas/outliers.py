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
    """What `/outliers` is asked beside the scene."""

    sensitivity: Annotated[
        Sensitivity,
        Field(
            description="how readily an alarm is raised: in about 2, 10 or 20 % of untouched "
            "scenes of the hardest large source, and of lists of few classes"
        ),
    ] = "medium"
    threshold: Annotated[
        Probability | None,
        Field(
            description="an object is an outlier from this probability on; left out: the model's "
            "threshold for `sensitivity`",
        ),
    ] = None


class OutliersRequest(OutliersOptions, SceneRequest):
    """What does not belong here, or stands in the wrong place?"""

    objects: SomeObjects


class Outlier(Reply):
    """How badly one object fits.

    `probability`: it does not belong, where half of the scenes hold an intruder. `log_odds`: of its
    class being present, given the rest of the scene.
    """

    object: str
    label: str
    probability: Probability
    log_odds: Finite
    is_outlier: bool
    because: Annotated[
        list[Because],
        Field(
            description="objects that support the verdict, strongest first, at most 3: of an "
            "outlier those that make it unlikely, of any other those that make it likely"
        ),
    ]
    usually_with: Annotated[
        list[str],
        Field(description="of an outlier: absent classes that would make it likely, at most 3"),
    ] = []


class MisplacedRelation(ScoredRelation):
    """A relation as the request spelled it, and the probability that it is false."""

    is_misplaced: Annotated[
        bool, Field(description="the probability reaches the threshold for `sensitivity`")
    ] = False


class OutliersAnswer(Answer):
    """Every object, least fitting first, and every relation given or observed, least likely first.

    In `misplaced`, `probability`: the relation is false.
    """

    threshold: Annotated[
        Probability | None,
        Field(description="probability from which an object is an outlier, as it was in force"),
    ] = None
    outliers: list[Outlier]
    misplaced: list[MisplacedRelation]


class OutliersFields(SceneFields, total=False):
    """The fields of `OutliersRequest`."""

    sensitivity: Sensitivity
    threshold: float
