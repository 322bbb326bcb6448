"""The contract of `/outliers`: which objects do not belong here, or are in the wrong place?"""

from __future__ import annotations

from typing import Literal

from scene_client.schemas.answers import Answer, Because, Reply, ScoredRelation
from scene_client.schemas.requests import (
    Detail,
    Finite,
    Probability,
    SceneFields,
    SceneRequest,
    SomeObjects,
)

Sensitivity = Literal["low", "medium", "high"]


class OutliersRequest(SceneRequest):
    """Which objects do not belong here, or are in the wrong place?"""

    objects: SomeObjects
    sensitivity: Sensitivity = "medium"
    """rate of alarms in unchanged scenes: at most about 2, 10 and 20 % of the scenes with low,
    medium and high. The rates apply to the large data source with the most alarms, and also to
    short lists of objects"""
    threshold: Probability | None = None
    """minimum probability of an outlier; default: threshold of the model for `sensitivity`"""
    detail: Detail = "full"
    """`scores` leaves `because` and `usually_with` out of the answer"""


Verdict = Literal["does-not-belong", "misdetection"]


class Outlier(Reply):
    """Result for one object: whether the object fits the scene, and whether it is real.

    `probability` is the probability that the object does not belong in the scene if it is real,
    under the assumption that half of all scenes contain an outlier. `log_odds` is ln(p / (1 - p))
    of this probability p. `real` is the probability that object and label are right, from the
    confidence of the detector and from the other objects.
    """

    object: str
    label: str
    """class of the object in the vocabulary"""
    listed_as: str | None = None
    """label of the object in the request; absent if it equals `label`"""
    broader: list[str] | None = None
    """broader classes, nearest first, such as lamp and light of a floor lamp; absent without any"""
    probability: Probability
    log_odds: Finite | None = None
    """absent for an object of probability 0, which is not judged"""
    real: Probability | None = None
    """absent if all objects have confidence 1, which counts as certain. A weak detection that does
    not fit is probably wrong"""
    is_outlier: bool
    """true if `probability` reaches the threshold, and `real` is at least 0.5. At a `sensitivity`,
    objects of a class that few training scenes show are never outliers, and objects of a single
    class never are; the warning `not-judged` names them"""
    reason: Verdict | None = None
    """`does-not-belong` for an outlier; `misdetection` if `real` is below 0.5; else absent"""
    because: list[Because] = []
    """other objects that explain `is_outlier`, largest effect first, at most 3. For an outlier,
    they raise its log-odds. Otherwise, they lower its log-odds"""
    usually_with: list[str] = []
    """for an outlier: absent classes that would make it likely, at most 3"""


Reason = Literal["relation", "on-floor", "wrong-support", "floats", "sunk-in"]


class MisplacedRelation(ScoredRelation):
    """A relation in the form of the request, or the place of a box.

    `probability` is the probability that it is wrong. With boxes, an entry is the likeliest wrong
    place of the object `subject`. For a box on the floor, above it or sunk into it, `object` is
    `floor`.
    """

    is_misplaced: bool = False
    """true if `probability` reaches the threshold for `sensitivity`"""
    reason: Reason = "relation"
    """`relation`: a relation that the request states. Others are places of boxes: `on-floor`, on
    the floor (on-top `floor`); `wrong-support`, on or in another object (on-top or inside);
    `floats`, held by no listed object (above `floor`); `sunk-in`, partly below the floor or within
    a solid object (inside). The place is wrong with `probability`"""
    moved: str | None = None
    """id of the object that stands in the wrong place if the relation is misplaced. With boxes, it
    is the subject"""


class OutliersAnswer(Answer):
    """Results for all objects, and for all stated relations or for the places of boxes.

    `outliers` starts with the most probable outlier. `misplaced` starts with the entry that is most
    probably wrong. If the request states relations, it has an entry for each of them that the model
    judges. Otherwise, it has at most one entry for each object with a box: supports, and other
    places that are wrong with a probability of at least .05. A model that was calibrated with too
    few scenes gives no judgement: the list is empty, and a warning says so.
    """

    threshold: Probability | None = None
    """minimum probability of an outlier that the service has used"""
    outliers: list[Outlier]
    misplaced: list[MisplacedRelation]


class OutliersFields(SceneFields, total=False):
    """The fields of `OutliersRequest`."""

    sensitivity: Sensitivity
    threshold: float
    detail: Detail
