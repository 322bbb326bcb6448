"""The description of a model by its trainer, without weights and files."""

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
"""A tuple whose validation stops at the first invalid item; a million errors take gigabytes."""


def _in_utc(moment: datetime) -> datetime:
    try:
        return moment.astimezone(UTC)
    except OverflowError:
        raise ValueError("must be in the years 1 to 9999 in UTC") from None


Timestamp = Annotated[AwareDatetime, AfterValidator(_in_utc)]


def to_json(value: Any) -> str:
    """Return one line of strict JSON; raise ValueError for NaN and infinity."""
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


class Frozen(BaseModel):
    """Base class of immutable models that refuse unknown fields and non-finite numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class CountSlope(Frozen):
    """Calibration of a logit z: log-odds = intercept + slope·z + log_count·log n.

    The meaning of n depends on the question; for outliers, n is the number of classes in the scene.
    """

    intercept: float = 0.0
    slope: float = 1.0
    log_count: float = 0.0

    def log_odds(self, z: Floats, n: int | NDArray[np.integer[Any]]) -> Floats:
        """Return the log-odds (N,) of logits z (N,); n is a number or an array (N,)."""
        found: Floats = self.intercept + self.log_count * np.log(n) + self.slope * z
        return found


class PairSlope(CountSlope):
    """Calibration of a relation between two objects.

    It adds log_classes·log(number of classes in the scene) to the formula of `CountSlope`, because
    annotators list a smaller share of the relations in a larger scene. n is the number of instance
    pairs of both classes. Each bend (at, change) adds change·(x - at) to a sum x > at.
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
    """Minimum probability of an alarm, by sensitivity."""

    low: Annotated[float, Field(ge=0, le=1)] = 0.5
    medium: Annotated[float, Field(ge=0, le=1)] = 0.5
    high: Annotated[float, Field(ge=0, le=1)] = 0.5


class EvidenceWeights(Frozen):
    """Weights of observed relations in the context, by kind of evidence and of question.

    Attributes:
        relations_on_objects, relations_on_relations: weights of relations that a request states,
            for questions about objects and about relations.
        poses_on_objects, poses_on_relations: the same for relations derived from poses.
    """

    relations_on_objects: Annotated[float, Field(ge=0, le=1)] = 1.0
    relations_on_relations: Annotated[float, Field(ge=0, le=1)] = 1.0
    poses_on_objects: Annotated[float, Field(ge=0, le=1)] = 1.0
    poses_on_relations: Annotated[float, Field(ge=0, le=1)] = 1.0


class Calibration(Frozen):
    """Calibration: conversion of a machine's log-odds into probabilities.

    The defaults change only the log-odds of unlisted classes; see `coverage`.

    Attributes:
        coverage: probability that a class in the scene is listed; a request may override it.
        coverage_weight: weight of the partial posterior in the log-odds, chosen on validation
            scenes. The rest is the closed form with unlisted classes absent.
        missing: calibration of the posterior log-odds of an unlisted class; n is the number of
            listed classes.
        evidence: weights of observed relations.
        popularity: (V,) log-odds of each class in a training scene; empty: equal for all classes.
        popularity_weight: alpha; the prior of an intruder is proportional to popularity^alpha.
        outlier_thresholds: minimum probability of an outlier.
        short_list_thresholds: outlier thresholds for scenes of 1, 2, ... classes without structure;
            larger scenes use `outlier_thresholds`.
        misplaced_thresholds: minimum probability of a misplaced relation.
        smallest: (C + 1,) number of classes that 90 % of the real rooms of each type reach; the
            last entry is for all rooms together. Empty: no minimum.
        room_fit: (C,) value of log p(v | room type) / p(v), up to a constant, that 85 % of the
            real rooms of each type reach. Empty: no minimum.
        outlier: calibration from the log-odds of presence to the log-odds of an intruder.
        relation: one entry per canonical relation.
        relation_given: entries for scenes with observed relations; if empty, `relation`.
        placement: entries for a missing object at its most probable places; if empty, `relation`.
        asked_place: entries for the place that a request names; if empty, `placement`.
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
    """One object class; `size` is its typical extent (x, y, z) in metres."""

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
            raise ValueError(f"relations must be the first of {CANONICAL}, in this order")
        self._words = Vocabulary.from_dict(self.model_dump(mode="json", exclude={"relations"}))
        return self

    @classmethod
    def of(cls, vocabulary: Vocabulary, relations: int = len(CANONICAL)) -> Self:
        """Return the entry of a vocabulary, for a machine of A = ``relations`` relations."""
        return cls.model_validate({**vocabulary.to_dict(), "relations": CANONICAL[:relations]})

    def vocabulary(self) -> Vocabulary:
        """Return the vocabulary."""
        return self._words


class DataSource(Frozen):
    """One source of training scenes: its name, size, digest and terms."""

    source: Text
    scenes: Count
    digest: Sha256
    terms: Text
    research_only: bool


class Metric(Frozen):
    """One measured figure with its 95 % interval over n units (scenes, removed objects, ...)."""

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
        training: configuration and seed of the training, free JSON.
        data: sources of the training scenes.
        metrics: figures measured on held-out scenes.
        terms: licence of the weights.
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
                raise ValueError(f"{length} {what}, but {name} = {self.spec.get(name)} in the spec")
        if (rooms := self.spec.get("C", 0)) not in (0, len(words.room_types)):
            raise ValueError(f"{len(words.room_types)} room types, but C = {rooms} in the spec")
        return self

    @property
    def variant(self) -> str:
        """rbm, gbm or triway."""
        return str(self.spec.get("variant"))
