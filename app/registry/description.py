"""What a trainer says about a model: everything but its numbers and its files."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import Annotated, Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    AwareDatetime,
    BaseModel,
    ConfigDict,
    FailFast,
    Field,
    JsonValue,
    PrivateAttr,
    StringConstraints,
    field_validator,
    model_validator,
)

from app.registry.references import ModelName, Version
from app.scene.relations import CANONICAL
from app.scene.vocabulary import Vocabulary

Sha256 = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")]
Text = Annotated[str, StringConstraints(min_length=1)]
Count = Annotated[int, Field(ge=0)]
Floats = NDArray[np.floating[Any]]

ItemT = TypeVar("ItemT")
Many = Annotated[tuple[ItemT, ...], FailFast()]
"""Validation stops at the first invalid item: errors of a million take gigabytes."""


def _in_utc(moment: datetime) -> datetime:
    try:
        return moment.astimezone(UTC)
    except OverflowError:
        raise ValueError("must lie in the years 1 to 9999 in UTC too") from None


Timestamp = Annotated[AwareDatetime, AfterValidator(_in_utc)]


def to_json(value: Any) -> str:
    """One line of strict JSON; raises ValueError for NaN and infinity."""
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


class Frozen(BaseModel):
    """Cannot be changed, and holds no unknown or non-finite field."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class CountSlope(Frozen):
    """A logit z of an answer, made a log-odds: intercept + slope·z + log_count·log n.

    What n counts is the answer's: classes of the scene for outliers.
    """

    intercept: float = 0.0
    slope: float = 1.0
    log_count: float = 0.0

    def log_odds(self, z: Floats, n: int | NDArray[np.integer[Any]]) -> Floats:
        """The log-odds of logits z (N,), of one n or of one each (N,)."""
        found: Floats = self.intercept + self.log_count * np.log(n) + self.slope * z
        return found


class PairSlope(CountSlope):
    """The same for a relation between two objects, and + log_classes·log of the scene's classes.

    n counts the instance pairs of both classes. In a room of many things an annotator lists fewer
    of what each could be related to. From each bend (at, change) on the sum x grows faster, by
    change·(x - at) for x > at, and slower for a negative change.
    """

    log_classes: float = 0.0
    bends: Many[tuple[float, float]] = ()


PairSlopes = Annotated[Many[PairSlope], Field(max_length=len(CANONICAL))]


class Slope(Frozen):
    """intercept + slope·z."""

    intercept: float = 0.0
    slope: float = 1.0


_RETIRED = frozenset(
    {"placed", "missing_temperature", "placed_temperature", "placed_relation_weight"}
    | {"outlier_threshold"}
)


class Thresholds(Frozen):
    """Probabilities from which an alarm is raised, by sensitivity."""

    low: Annotated[float, Field(ge=0, le=1)] = 0.5
    medium: Annotated[float, Field(ge=0, le=1)] = 0.5
    high: Annotated[float, Field(ge=0, le=1)] = 0.5


class EvidenceWeights(Frozen):
    """How strongly given relations pull the context, by kind of evidence and of question.

    Attributes:
        relations_on_objects, relations_on_relations: relations that a request states.
        poses_on_objects, poses_on_relations: relations derived from positions.
    """

    relations_on_objects: Annotated[float, Field(ge=0, le=1)] = 1.0
    relations_on_relations: Annotated[float, Field(ge=0, le=1)] = 1.0
    poses_on_objects: Annotated[float, Field(ge=0, le=1)] = 1.0
    poses_on_relations: Annotated[float, Field(ge=0, le=1)] = 1.0


class Calibration(Frozen):
    """How a machine's log-odds become the probabilities that the service promises.

    The defaults change no log-odds but those of unlisted classes, see `coverage`.

    Attributes:
        coverage: probability that a class which is present is listed, unless a request says.
        coverage_weight: share of the partial posterior in the log-odds; the rest is the closed form
            with unlisted classes absent; chosen on validation.
        missing: posterior log-odds of an unlisted class to the calibrated ones; n counts the listed
            classes.
        evidence: see `EvidenceWeights`.
        popularity: (V,) log-odds of finding each class in a training scene; empty: all alike.
        popularity_weight: alpha of the prior of an intruder, proportional to popularity^alpha.
        outlier_thresholds: probabilities from which an object is an outlier.
        short_list_thresholds: the same for lists of 1, 2, ... classes, structure aside; longer
            lists have `outlier_thresholds`.
        misplaced_thresholds: probabilities from which a relation is misplaced.
        smallest: (C + 1,) classes that nine in ten real rooms of each type have at least,
            and last of all rooms together; empty: any number.
        room_fit: (C,) what 85 % of the real rooms of each type have at least of
            log p(v | room type) / p(v), up to a constant; empty: any value.
        outlier: presence log-odds to the log-odds of being an intruder.
        relation: one entry a canonical relation.
        relation_given: the same where some relations of the scene are given; `relation` if empty.
        placement: the same for a missing object and one that is there, at its likeliest places;
            `relation` if empty.
        asked_place: the same at the place that a request asks for; `placement` if empty.
        misplaced: relation log-odds to the log-odds of being false.
    """

    coverage: Annotated[float, Field(ge=0, le=1)] = 0.5
    coverage_weight: Annotated[float, Field(ge=0, le=1)] = 0.5
    missing: CountSlope = CountSlope()
    evidence: EvidenceWeights = EvidenceWeights()
    popularity: Many[float] = ()
    popularity_weight: Annotated[float, Field(ge=0, le=1)] = 0.0
    outlier_thresholds: Thresholds = Thresholds()
    short_list_thresholds: Annotated[Many[Thresholds], Field(max_length=256)] = ()
    misplaced_thresholds: Thresholds = Thresholds()
    smallest: Many[Count] = ()
    room_fit: Many[float] = ()
    outlier: CountSlope = CountSlope()
    relation: PairSlopes
    relation_given: PairSlopes = ()
    placement: PairSlopes = ()
    asked_place: PairSlopes = ()
    misplaced: Slope = Slope()

    @model_validator(mode="before")
    @classmethod
    def _without_retired(cls, values: Any) -> Any:
        """Pass over what earlier releases wrote."""
        if not isinstance(values, dict):
            return values
        return {name: value for name, value in values.items() if name not in _RETIRED}

    @classmethod
    def neutral(cls, relations: int) -> Self:
        """The calibration that changes nothing, for A canonical relations."""
        return cls(relation=(PairSlope(),) * relations)


class ClassEntry(Frozen):
    """One object class; `size` is its typical extent in metres, x, y, z."""

    label: Text
    aliases: Many[Text] = ()
    structure: bool = False
    size: tuple[float, float, float] | None = None


class VocabularyEntry(Frozen):
    """The words of a model, in the order of its units."""

    objects: Many[ClassEntry]
    relations: Many[str] = CANONICAL
    room_types: Many[Text] = ()
    _words: Vocabulary = PrivateAttr()

    @model_validator(mode="after")
    def _is_a_vocabulary(self) -> Self:
        if self.relations != CANONICAL[: len(self.relations)]:
            raise ValueError(f"relations must be the canonical ones in their order: {CANONICAL}")
        self._words = Vocabulary.from_dict(self.model_dump(mode="json", exclude={"relations"}))
        return self

    @classmethod
    def of(cls, vocabulary: Vocabulary, relations: int = len(CANONICAL)) -> Self:
        """The entry of a vocabulary, for a machine of A = `relations`."""
        return cls.model_validate({**vocabulary.to_dict(), "relations": CANONICAL[:relations]})

    def vocabulary(self) -> Vocabulary:
        """The vocabulary itself."""
        return self._words


class DataSource(Frozen):
    """Scenes that the model was trained on, their digest and their terms."""

    source: Text
    scenes: Count
    digest: Sha256
    terms: Text
    research_only: bool


class Metric(Frozen):
    """One measured figure with its 95 % interval over n units (scenes, removed objects …)."""

    task: Text
    source: Text
    metric: Text
    value: float
    low: float
    high: float
    n: Annotated[int, Field(ge=1)]

    @model_validator(mode="after")
    def _is_interval(self) -> Self:
        if self.low > self.high:
            raise ValueError(f"low ({self.low}) must not exceed high ({self.high})")
        return self


class Description(Frozen):
    """What the trainer says about a model; all of the manifest but what describes the files.

    Attributes:
        name, version: where the artifact is published.
        created: when; kept in UTC.
        spec: `MachineSpec.to_dict()`.
        vocabulary: words in the order of the units; V, A and C of them.
        calibration: see `Calibration`.
        training: configuration and seed, free JSON.
        data: the sources trained on.
        metrics: measured on held-out scenes.
        terms: licence of the weights, in words.
        libraries: versions that the model was trained with.
    """

    name: ModelName
    version: Version
    created: Timestamp
    spec: dict[str, JsonValue]
    vocabulary: VocabularyEntry
    calibration: Calibration
    training: dict[str, JsonValue]
    data: Many[DataSource]
    metrics: Many[Metric]
    terms: Text
    libraries: dict[str, str]

    @field_validator("spec", "training", "libraries", "terms")
    @classmethod
    def _can_be_written(cls, value: JsonValue) -> JsonValue:
        # pydantic lets NaN and lone surrogates through in free JSON.
        to_json(value).encode()
        return value

    @model_validator(mode="after")
    def _fits_spec(self) -> Self:
        words = self.vocabulary
        for name, what, length in (
            ("V", "vocabulary objects", len(words.objects)),
            ("A", "vocabulary relations", len(words.relations)),
            ("A", "calibration relations", len(self.calibration.relation)),
            *(
                ("A", f"calibration {kind}", len(entries or self.calibration.relation))
                for kind, entries in (
                    ("relations given others", self.calibration.relation_given),
                    ("placements", self.calibration.placement),
                    ("a place asked for", self.calibration.asked_place),
                )
            ),
        ):
            if self.spec.get(name) != length:
                raise ValueError(f"{length} {what}, but {name} = {self.spec.get(name)} in the spec")
        if (rooms := self.spec.get("C", 0)) not in (0, len(words.room_types)):
            raise ValueError(f"{len(words.room_types)} room types, but C = {rooms} in the spec")
        return self

    @property
    def variant(self) -> str:
        """rbm, gbm or triway."""
        return str(self.spec.get("variant"))
