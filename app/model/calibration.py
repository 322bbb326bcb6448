"""The calibration of a model: how its log-odds become probabilities, and when it raises an alarm.

Validation scenes determine the coefficients (`training.fit`).
"""

import math
from collections.abc import Mapping
from typing import Annotated, Any, Final, NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from pydantic import Field, model_validator

from app.model.fields import Count, Frozen, Many
from app.scene.spatial_relations import CANONICAL
from scene_client.schemas import Sensitivity as Sensitivity

Floats = NDArray[np.floating[Any]]


class CountSlope(Frozen):
    """Calibration of a logit z: log-odds = intercept + slope·z + log_count·log n.

    `Calibration` and `PAIR_CALIBRATIONS` define n.
    """

    intercept: float = 0.0
    slope: float = 1.0
    log_count: float = 0.0


class CoverageFit(CountSlope):
    """Calibration of a logit z about a scene of which a list of n classes is the share s:

        log-odds = intercept + slope·z + log_count·log n + log_share·log s
                   + both·log n·log s + last·[s = 1]

    A share below `LEAST_COVERAGE` counts as this share.
    """

    log_share: float = 0.0
    both: float = 0.0
    last: float = 0.0


LEAST_COVERAGE: Final = 0.15  # least share of a scene that the base rates of `/missing` tell apart


class RealFit(Frozen):
    """The log-odds that a detection is right: object and label.

    With the confidence c of the detector and the score s of the class given the other n - 1 listed
    classes, they are intercept + confidence·logit(c) + context·s + log_count·log n. s is the
    log-odds of the class minus its prior as an intruder. `training.fit.calibrate_doubt` states the
    model of detectors.
    """

    intercept: float
    confidence: Annotated[float, Field(ge=0)]
    context: Annotated[float, Field(ge=0)]
    log_count: float


class LabelFit(Frozen):
    """The logit of one of several labels of an object: confidence·logit(c) + context·z.

    c is the confidence of the label, and z are the log-odds of its class given the other objects.
    The probabilities of the labels are the softmax of their logits.
    """

    confidence: Annotated[float, Field(ge=0)] = 1.0
    context: Annotated[float, Field(ge=0)] = 1.0


PairSlopes = Annotated[Many[CountSlope], Field(max_length=len(CANONICAL))]

PAIR_CALIBRATIONS: Final = ("relation", "relation_given", "placement")
"""Fields of `Calibration` with one `CountSlope` for each canonical relation.

n of this entry is the number of object pairs with the two classes of the relation.
"""


class PlaceFit(Frozen):
    """The log-odds that a class, if it is present, stands at the place that a request names.

    With the model's log probability p of the relation to the anchor, and the log ratio c of the
    counts (`Places.log_ratio`), they are

        intercept + relation·p + counts·c
    """

    relation: Annotated[float, Field(ge=0)] = 1.0
    counts: Annotated[float, Field(ge=0)] = 0.0
    intercept: float = 0.0


class WhereFit(Frozen):
    """The rooms of a thing in `/where`, with the log-odds l_r of `/missing` for each room r.

    p(room r | it is in one of the rooms) is the softmax of slope·l_r. The log-odds that it is in
    one of them are intercept + here·log sum_r exp(l_r). Within a room, a place of the log-odds q
    has the weight exp(place_intercept + place_slope·q), and the rest of the room has 1.
    """

    slope: Annotated[float, Field(ge=0)] = 1.0
    here: Annotated[float, Field(ge=0)] = 1.0
    intercept: float = 0.0
    place_slope: Annotated[float, Field(ge=0)] = 1.0
    place_intercept: float = 0.0


PlaceFits = Annotated[Many[PlaceFit], Field(max_length=len(CANONICAL))]


class Sharpness(Frozen):
    """Calibration of probabilities p of exclusive answers: p^(slope + log_count·log n) / sum.

    n is the number of listed classes without structure, at least 1.
    """

    slope: float = 1.0
    log_count: float = 0.0

    def of(self, n: int) -> float:
        """Return the exponent for a list of n classes. It is at least 0.05."""
        return max(self.slope + self.log_count * math.log(max(n, 1)), 0.05)


class FitLimit(Frozen):
    """Minimum of `app.questions.generate.room_fit`: intercept + log_count·log n for n classes."""

    intercept: float
    log_count: float = 0.0

    def of(self, n: int) -> float:
        """Return the minimum for a scene of n classes."""
        return self.intercept + self.log_count * math.log(max(n, 1))


NO_LIMIT: Final = FitLimit(intercept=-1e9)

RARELY: Final = 1 / 500
"""A class is rarely shown if a smaller share of the training scenes shows it."""

LONGEST_JUDGED: Final = 36
"""Maximum number of listed classes to which alarm lines are fitted. Longer lists count as such."""

LEAST_ALARM: Final[Mapping[Sensitivity, float]] = {"low": 0.5, "medium": 0.3, "high": 0.15}
"""Minimum probability of an alarm. Where the scores of right and wrong objects hardly overlap, the
permitted share of alarms alone would flag objects that probably belong."""


class AlarmLine(Frozen):
    """Minimum log-odds of an alarm in n entries: intercept + log_count·log n + curve·log² n."""

    intercept: float
    log_count: float = 0.0
    curve: float = 0.0

    def threshold(self, n: int) -> float:
        """Return the minimum probability of an alarm in a list of n entries."""
        log_n = math.log(max(n, 1))
        log_odds = self.intercept + (self.log_count + self.curve * log_n) * log_n
        return 0.5 + 0.5 * math.tanh(log_odds / 2)  # tanh cannot overflow


class AlarmLines(Frozen):
    """The alarm line of each sensitivity."""

    low: AlarmLine
    medium: AlarmLine
    high: AlarmLine


KINDS: Final = (
    *("lateral", "support", "above", "under"),
    *("on_floor", "on_object", "unheld"),
)
"""Kinds of entries in `misplaced`; see `app.questions.misplaced`. The last three are of boxes."""

WEIGHTS: Final = ("relation", "change", "stand", "supporter", "unknown", "entries")
"""Fields of `Judgement` with the weights of the terms z, d, s, q, u and l of an entry."""


class Judgement(Frozen):
    """The log-odds that an entry of `misplaced` is wrong, and the lines of an alarm.

    The log-odds are intercept + relation·z + change·d + stand·s + supporter·q + unknown·u +
    entries·l, with the terms of `app.questions.misplaced`. n of the lines is the number of entries
    of the kind in the scene.
    """

    intercept: float
    relation: float
    change: float
    stand: float
    supporter: float
    unknown: float
    entries: float
    lines: AlarmLines


class Misplaced(Frozen):
    """The judgement of each kind of entry. None: training had too few scenes for the fit."""

    lateral: Judgement | None = None
    support: Judgement | None = None
    above: Judgement | None = None
    under: Judgement | None = None
    on_floor: Judgement | None = None
    on_object: Judgement | None = None
    unheld: Judgement | None = None
    # Relations (relation, subject, object) between classes that a person has confirmed.
    confirmed: Many[tuple[Count, Count, Count]] = ()

    @property
    def judges_relations(self) -> bool:
        """Whether the model judges any kind of relation."""
        return any(getattr(self, kind) is not None for kind in KINDS)


class Calibration(Frozen):
    """The conversion of a machine's log-odds into probabilities.

    With the default values, the calibration changes nothing, and the model judges neither objects
    nor relations. An intruder is an object that does not belong to the scene. Tuples of the V
    classes or C room types may be empty: all classes are equally popular, or there is no minimum.
    For `missing` and `outlier`, n is the number of listed classes without structure.
    """

    # Share of the classes of a scene that the base rates of `/missing` assume by default.
    coverage: Annotated[float, Field(ge=0, le=1)] = 0.5
    missing: CountSlope = CountSlope()  # log-odds of presence, if a request states no coverage
    covered: CoverageFit = CoverageFit()  # the same if a request states the coverage
    # (V,) log-odds that a training scene has each class; None: no source shows it in training.
    popularity: Many[float | None] = ()
    # alpha: the prior probability of an intruder's class is proportional to popularity^alpha, where
    # popularity is the odds of the class.
    popularity_weight: Annotated[float, Field(ge=0, le=1)] = 0.0
    outlier_lines: AlarmLines | None = None  # by n; None exactly if `outlier` is None
    room_lines: AlarmLines | None = None  # with a stated room type; None: as `outlier_lines`
    rooms: Sharpness = Sharpness()
    several_rooms: float | None = None  # least gain of a warning (`app.questions.several_rooms`)
    rare_rooms: Many[Count] = ()  # room types with too few training scenes for `/generate`
    written_rooms: Many[Count] = ()  # room types that written scenes alone show
    # (C + 1,) minimum number of classes in a generated scene of each room type, then of none.
    smallest: Many[Count] = ()
    # (C,) minimum fit of a generated scene of each room type. About 95 % of the lists of whole
    # rooms reach both limits (`training.fit.calibrate_rooms`).
    room_fit: Many[FitLimit] = ()
    # From log-odds of presence to log-odds of an intruder. None: training had too few scenes for
    # the fit, so the model judges no object.
    outlier: CountSlope | None = None
    real: RealFit | None = None  # None: the confidence is the probability that a detection is right
    labels: LabelFit = LabelFit()  # decision among the labels of an object with alternatives
    # Calibrations of each canonical relation: without and with observed relations, and for a
    # missing object at its most probable places, and at the place that a request names.
    relation: PairSlopes
    relation_given: PairSlopes
    placement: PairSlopes
    at: PlaceFits
    where: WhereFit = WhereFit()
    misplaced: Misplaced = Misplaced()  # observed relations, and objects on the floor or a wall

    @model_validator(mode="after")
    def _check_outlier_lines(self) -> Self:
        if (self.outlier is None) != (self.outlier_lines is None):
            raise ValueError("outlier and outlier_lines must both have a value, or neither")
        return self

    def outlier_threshold(self, sensitivity: Sensitivity, n: int, *, in_room: bool) -> float | None:
        """Return the minimum probability of an outlier in a list of n classes without structure.

        It is at least `LEAST_ALARM`. It is None if the model judges no object.
        """
        lines = (self.room_lines if in_room else None) or self.outlier_lines
        if lines is None:
            return None
        line: AlarmLine = getattr(lines, sensitivity)
        return max(line.threshold(min(n, LONGEST_JUDGED)), LEAST_ALARM[sensitivity])

    def rarely_shown(self, classes: int) -> Bool[NDArray[np.bool_], "V"]:
        """Return True for classes that fewer than `RARELY` of the training scenes show."""
        if not self.popularity:
            return np.zeros(classes, np.bool_)
        popularity = np.array(self.popularity, dtype=np.float64)
        return ~(popularity >= math.log(RARELY / (1 - RARELY)))  # NaN: no training scene

    @classmethod
    def neutral(cls, relations: int) -> Self:
        """Return the calibration with default values for A = ``relations`` canonical relations."""
        neutral = dict.fromkeys(PAIR_CALIBRATIONS, (CountSlope(),) * relations)
        return cls.model_validate({**neutral, "at": (PlaceFit(),) * relations})


class RelationSlopes(NamedTuple):
    """Calibration tables of the A canonical relations, named as the fields of `Calibration`.

    Each row is the `CountSlope` of one relation: intercept, slope, log_count.
    """

    relation: Float[Floats, "A 3"]
    relation_given: Float[Floats, "A 3"]
    placement: Float[Floats, "A 3"]

    @classmethod
    def of(cls, calibration: Calibration) -> Self:
        """Build the tables of a calibration."""
        fields = (getattr(calibration, name) for name in PAIR_CALIBRATIONS)
        tables = ([(fit.intercept, fit.slope, fit.log_count) for fit in field] for field in fields)
        return cls(*(np.array(table, np.float32).reshape(-1, 3) for table in tables))
