"""The contract of `/outliers`: which objects do not belong here, or are in the wrong place?"""

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
            description="alarm rate. With low, medium and high, about 2, 10 and 20 % of the "
            "unchanged scenes of the hardest large source raise an alarm. The same rates hold for "
            "short lists"
        ),
    ] = "medium"
    threshold: Annotated[
        Probability | None,
        Field(
            description="minimum probability of an outlier; default: the model's threshold for "
            "`sensitivity`",
        ),
    ] = None


class OutliersRequest(OutliersOptions, SceneRequest):
    """Which objects do not belong here, or are in the wrong place?"""

    objects: SomeObjects


class Outlier(Reply):
    """How well one object fits the scene.

    `probability` is the probability that the object does not belong, if half of all scenes contain
    an intruder. `log_odds` are the log-odds that its class is present, given the rest of the scene.
    """

    object: str
    label: str
    probability: Probability
    log_odds: Finite
    is_outlier: bool
    because: Annotated[
        list[Because],
        Field(
            description="objects that explain `is_outlier`, strongest first, at most 3. They make "
            "an outlier unlikely, and any other object likely"
        ),
    ]
    usually_with: Annotated[
        list[str],
        Field(description="for an outlier: absent classes that would make it likely, at most 3"),
    ] = []


class MisplacedRelation(ScoredRelation):
    """A relation, with the name from the request, and the probability that it is false."""

    is_misplaced: Annotated[
        bool, Field(description="true if `probability` reaches the threshold of `sensitivity`")
    ] = False


class OutliersAnswer(Answer):
    """Objects, most probable outlier first, and observed relations, most probably false first.

    In `misplaced`, `probability` is the probability that the relation is false.
    """

    threshold: Annotated[
        Probability | None,
        Field(description="applied minimum probability of an outlier"),
    ] = None
    outliers: list[Outlier]
    misplaced: list[MisplacedRelation]


class OutliersFields(SceneFields, total=False):
    """The fields of `OutliersRequest`."""

    sensitivity: Sensitivity
    threshold: float
