"""The description of a model, as training writes it: metadata without weights and files."""

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
"""A tuple whose validation stops at the first invalid item. A million errors would take gigabytes
of memory."""


def _in_utc(moment: datetime) -> datetime:
    try:
        return moment.astimezone(UTC)
    except OverflowError:
        raise ValueError("the time must be in the years 1 to 9999 in UTC") from None


Timestamp = Annotated[AwareDatetime, AfterValidator(_in_utc)]


def to_json(value: Any) -> str:
    """Return a value as one line of JSON. Raise ValueError for NaN and infinity."""
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


class Frozen(BaseModel):
    """Base class of immutable models that refuse unknown fields and non-finite numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class CountSlope(Frozen):
    """Calibration of a logit z: log-odds = intercept + slope·z + log_count·log n.

    The meaning of n depends on the question. For outliers, n is the number of classes in the scene.
    """

    intercept: float = 0.0
    slope: float = 1.0
    log_count: float = 0.0

    def log_odds(self, z: Floats, n: int | NDArray[np.integer[Any]]) -> Floats:
        """Return the log-odds of logits z, both (N,). n is a number or an array (N,)."""
        found: Floats = self.intercept + self.log_count * np.log(n) + self.slope * z
        return found


class PairSlope(CountSlope):
    """Calibration of a relation between two objects.

    It adds log_classes·log(number of classes in the scene) to the formula of `CountSlope`, because
    annotators list a smaller share of the relations in a larger scene. n is the number of instance
    pairs of both classes. The result x then runs through a piecewise-linear curve: each bend (at,
    change) adds change·(x - at) if x is above ``at``.
    """

    log_classes: float = 0.0
    bends: Many[tuple[float, float]] = ()


PairSlopes = Annotated[Many[PairSlope], Field(max_length=len(CANONICAL))]


class Slope(Frozen):
    """Calibration of a logit z without counts: log-odds = intercept + slope·z."""

    intercept: float = 0.0
    slope: float = 1.0


_RETIRED = frozenset(
    {"placed", "missing_temperature", "placed_temperature", "placed_relation_weight"}
    | {"outlier_threshold"}
)


class Thresholds(Frozen):
    """Minimum probability of an alarm for each sensitivity."""

    low: Annotated[float, Field(ge=0, le=1)] = 0.5
    medium: Annotated[float, Field(ge=0, le=1)] = 0.5
    high: Annotated[float, Field(ge=0, le=1)] = 0.5


class EvidenceWeights(Frozen):
    """Weights with which observed relations act on the hidden units.

    Attributes:
        relations_on_objects: weight of relations that a request states, for questions about
            objects.
        relations_on_relations: weight of these relations for questions about relations.
        poses_on_objects: weight of relations derived from poses, for questions about objects.
        poses_on_relations: weight of these relations for questions about relations.
    """

    relations_on_objects: Annotated[float, Field(ge=0, le=1)] = 1.0
    relations_on_relations: Annotated[float, Field(ge=0, le=1)] = 1.0
    poses_on_objects: Annotated[float, Field(ge=0, le=1)] = 1.0
    poses_on_relations: Annotated[float, Field(ge=0, le=1)] = 1.0


class Calibration(Frozen):
    """The conversion of a machine's log-odds into probabilities.

    With the default values, only `coverage` changes log-odds: those of unlisted classes.

    Attributes:
        coverage: probability that a request lists a class of the scene. A request may override it.
        coverage_weight: weight of the log-odds under partial coverage, chosen on validation scenes.
            The remaining weight belongs to the closed form, where unlisted classes are absent.
        missing: calibration of the posterior log-odds of an unlisted class. n is the number of
            listed classes.
        evidence: weights of observed relations.
        popularity: (V,) log-odds that a training scene has the class. If empty, all classes are
            equal.
        popularity_weight: exponent alpha. The prior of an intruder is proportional to
            popularity^alpha.
        outlier_thresholds: minimum probability of an outlier.
        short_list_thresholds: outlier thresholds for scenes of 1, 2, ... classes, without
            structural classes. Larger scenes use `outlier_thresholds`.
        misplaced_thresholds: minimum probability of a misplaced relation.
        smallest: (C + 1,) minimum number of classes in a generated room of each type. 90 % of the
            real rooms reach it. The last entry is for all rooms. If empty, there is no minimum.
        room_fit: (C,) minimum of log p(v | room type) / p(v), up to a constant, for a generated
            room of each type. 85 % of the real rooms reach it. If empty, there is no minimum.
        outlier: calibration from the log-odds of presence to the log-odds of an intruder.
        relation: one entry for each canonical relation.
        relation_given: entries for scenes with observed relations. If empty, `relation` applies.
        placement: entries for a missing object at its most probable places. If empty, `relation`
            applies.
        asked_place: entries for the place that a request names. If empty, `placement` applies.
        misplaced: calibration from the log-odds of a relation to the log-odds that it is false.
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
        """Ignore fields that only earlier releases used."""
        if not isinstance(values, dict):
            return values
        return {name: value for name, value in values.items() if name not in _RETIRED}

    @classmethod
    def neutral(cls, relations: int) -> Self:
        """Return the neutral calibration for A = ``relations`` canonical relations."""
        return cls(relation=(PairSlope(),) * relations)


class ClassEntry(Frozen):
    """One object class. `size` is its typical extent (x, y, z) in metres."""

    label: Text
    aliases: Many[Text] = ()
    structure: bool = False
    size: tuple[float, float, float] | None = None


class VocabularyEntry(Frozen):
    """The object classes, relations and room types of a model, in the order of its units."""

    objects: Many[ClassEntry]
    relations: Many[str] = CANONICAL
    room_types: Many[Text] = ()
    _words: Vocabulary = PrivateAttr()

    @model_validator(mode="after")
    def _is_a_vocabulary(self) -> Self:
        if self.relations != CANONICAL[: len(self.relations)]:
            raise ValueError(
                f"relations must be the first entries of {CANONICAL}, in the same order"
            )
        self._words = Vocabulary.from_dict(self.model_dump(mode="json", exclude={"relations"}))
        return self

    @classmethod
    def of(cls, vocabulary: Vocabulary, relations: int = len(CANONICAL)) -> Self:
        """Return the entry of a vocabulary for a machine with A = ``relations`` relations."""
        return cls.model_validate({**vocabulary.to_dict(), "relations": CANONICAL[:relations]})

    def vocabulary(self) -> Vocabulary:
        """Return the vocabulary."""
        return self._words


class DataSource(Frozen):
    """One source of training scenes: its name, number of scenes, digest and terms of use."""

    source: Text
    scenes: Count
    digest: Sha256
    terms: Text
    research_only: bool


class Metric(Frozen):
    """One measured figure with its 95 % confidence interval [low, high].

    n is the number of measured units, such as scenes or removed objects.
    """

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
    """The description of a model: its manifest without the entries about files.

    Attributes:
        name, version: name and version in the store.
        created: time of creation, in UTC.
        spec: `MachineSpec.to_dict()`.
        vocabulary: V object classes, A relations and C room types, in the order of the units.
        calibration: conversion of log-odds into probabilities.
        training: configuration and seed of the training, as JSON without a schema.
        data: sources of the training scenes.
        metrics: figures measured on held-out scenes.
        terms: terms of use of the weights.
        libraries: versions of the libraries used in training.
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
        # pydantic accepts NaN and lone surrogates in free JSON.
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
                    ("entries of relation_given", self.calibration.relation_given),
                    ("entries of placement", self.calibration.placement),
                    ("entries of asked_place", self.calibration.asked_place),
                )
            ),
        ):
            if self.spec.get(name) != length:
                raise ValueError(
                    f"the description has {length} {what}, but the spec has "
                    f"{name} = {self.spec.get(name)}"
                )
        if (rooms := self.spec.get("C", 0)) not in (0, len(words.room_types)):
            raise ValueError(
                f"the vocabulary has {len(words.room_types)} room types, but the spec has "
                f"C = {rooms}"
            )
        return self

    @property
    def variant(self) -> str:
        """Variant of the machine, such as triway."""
        return str(self.spec.get("variant"))
