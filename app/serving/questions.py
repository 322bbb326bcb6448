"""The four questions: a request in, a scene to the model, an answer in names out."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from typing import cast

from app import reasoning
from app.scene.frames import viewer_axes
from app.scene.relations import opposite
from app.schemas import (
    Because,
    Disagreement,
    GenerateAnswer,
    GeneratedScene,
    GenerateRequest,
    MissingAnswer,
    MissingObject,
    MissingRequest,
    Offset,
    Outlier,
    OutliersAnswer,
    OutliersRequest,
    Placement,
    Relation,
    RelationName,
    RelationsAnswer,
    RelationsRequest,
    ScoredRelation,
    Vector,
)
from app.serving.errors import Location, Reason
from app.serving.models import ServedModel
from app.serving.reading import Faults, Reading, unknown_label
from app.serving.session import Session

DRAWN_SEED_BITS = 53
"""Every JSON reader can hand such a seed back: a double holds it exactly."""


async def relations(session: Session, request: RelationsRequest) -> RelationsAnswer:
    """How do these objects stand to each other?

    Raises:
        RequestError, UnknownModelError, ModelUnavailableError: see `Session.read`.
        QueueFullError, DeadlinePassedError, DisconnectedError: see `Session.ask`.
    """
    model, reading = session.read(request)
    pairs = _pairs(request, reading)
    found, disagreements = await session.ask(
        model,
        reasoning.relations,
        reading.scene,
        top_k=request.top_k,
        min_probability=request.min_probability,
        pairs=pairs,
        include_opposites=request.include_opposites,
    )
    return RelationsAnswer(
        **session.envelope(request, model, reading),
        relations=_scored(found, reading),
        disagreements=[
            Disagreement(
                subject=reading.id(entry.subject),
                object=reading.id(entry.object),
                observed=[_name(relation) for relation in entry.observed],
                expected=_name(entry.expected),
                probability=entry.probability,
                observed_probability=entry.observed_probability,
            )
            for entry in disagreements
        ],
    )


async def missing(session: Session, request: MissingRequest) -> MissingAnswer:
    """What else should be here, and where?

    Raises:
        RequestError, UnknownModelError, ModelUnavailableError: see `Session.read`.
        QueueFullError, DeadlinePassedError, DisconnectedError: see `Session.ask`.
    """
    model, reading = session.read(request)
    faults = Faults()
    # The default is for vocabularies of any size; a number of one's own is not cut down in silence.
    if request.top_k > len(model.vocabulary) and "top_k" in request.model_fields_set:
        message = f"must not be above {len(model.vocabulary)}, the size of the model's vocabulary"
        faults.add(Reason.INVALID, ("top_k",), message)
    candidates, dropped = _candidates(request, model, faults)
    at = _place(request, model, reading, faults)
    faults.raise_any()
    viewpoint = request.viewpoint
    found = await session.ask(
        model,
        reasoning.missing,
        reading.scene,
        top_k=request.top_k,
        candidates=candidates,
        at=at,
        axes=viewer_axes(request.frame_id, None if viewpoint is None else viewpoint.yaw),
    )
    envelope = session.envelope(request, model, reading)
    envelope["ignored"] += dropped
    return MissingAnswer(
        **envelope,
        missing=[
            MissingObject(
                label=entry.label,
                probability=entry.probability,
                log_odds=entry.log_odds,
                placements=[
                    Placement(
                        relation=_name(place.relation),
                        object=reading.id(place.object),
                        probability=place.probability,
                        offset=_offset(place.offset),
                    )
                    for place in entry.placements
                ],
                because=_because(entry.because, reading),
            )
            for entry in found
        ],
    )


async def outliers(session: Session, request: OutliersRequest) -> OutliersAnswer:
    """What does not belong here, or stands in the wrong place?

    Raises:
        RequestError, UnknownModelError, ModelUnavailableError: see `Session.read`.
        QueueFullError, DeadlinePassedError, DisconnectedError: see `Session.ask`.
    """
    model, reading = session.read(request)
    found, misplaced = await session.ask(
        model, reasoning.outliers, reading.scene, threshold=request.threshold
    )
    return OutliersAnswer(
        **session.envelope(request, model, reading),
        outliers=[
            Outlier(
                object=reading.id(entry.object),
                label=entry.label,
                probability=entry.probability,
                log_odds=entry.log_odds,
                is_outlier=entry.is_outlier,
                because=_because(entry.because, reading),
            )
            for entry in found
        ],
        misplaced=_scored(misplaced, reading),
    )


async def generate(session: Session, request: GenerateRequest) -> GenerateAnswer:
    """What would a scene like this look like?

    Raises:
        RequestError, UnknownModelError, ModelUnavailableError: see `Session.read`.
        QueueFullError, DeadlinePassedError, DisconnectedError: see `Session.ask`.
    """
    model, reading = session.read(request, may_be_empty=True)
    _check_context(request, model)
    seed = secrets.randbits(DRAWN_SEED_BITS) if request.seed is None else request.seed

    def draw(stop: Callable[[], bool]) -> tuple[reasoning.GeneratedScene, ...]:
        return reasoning.generate(
            model.artifact,
            reading.scene,
            count=request.count,
            seed=seed,
            steps=request.steps,
            temperature=request.temperature,
            context=request.context,
            stop=stop,
        )

    drawn = await session.draw(request.count, model, "generate", draw)
    return GenerateAnswer(
        **session.envelope(request, model, reading),
        seed=seed,
        scenes=[
            GeneratedScene(
                objects=list(scene.objects),
                relations=[
                    Relation(subject=subject, relation=_name(relation), object=other)
                    for subject, relation, other in scene.relations
                ],
                log_score=scene.log_score,
                context={layer: list(units) for layer, units in scene.context.items()},
            )
            for scene in drawn
        ],
    )


def _because(causes: Sequence[reasoning.Because], reading: Reading) -> list[Because]:
    return [Because(reading.id(cause.object), cause.log_odds_change) for cause in causes]


def _name(relation: str) -> RelationName:
    return cast("RelationName", relation)


def _offset(offset: reasoning.Offset | None) -> Offset | None:
    return offset and Offset(Vector(*offset.mean), Vector(*offset.std), offset.scenes)


def _scored(
    found: Sequence[reasoning.RelationAnswer | reasoning.MisplacedAnswer], reading: Reading
) -> list[ScoredRelation]:
    return [
        ScoredRelation(
            subject=reading.id(entry.subject),
            relation=_name(entry.relation),
            object=reading.id(entry.object),
            probability=entry.probability,
        )
        for entry in found
    ]


def _pairs(request: RelationsRequest, reading: Reading) -> list[tuple[int, int]] | None:
    if request.pairs is None:
        return None
    faults = Faults()
    names = reading.names
    pairs: dict[tuple[int, int], None] = {}
    for place, pair in enumerate(request.pairs):
        location: Location = ("pairs", place)
        if names.is_ignored(pair.subject) or names.is_ignored(pair.object):
            continue
        subject = names.find(pair.subject, (*location, "subject"), faults)
        other = names.find(pair.object, (*location, "object"), faults)
        if subject is None or other is None:
            continue
        if subject == other:
            faults.add(Reason.INVALID, location, "a pair needs two objects")
            continue
        pairs[subject, other] = None
    faults.raise_any()
    return list(pairs)


def _candidates(
    request: MissingRequest, model: ServedModel, faults: Faults
) -> tuple[list[int] | None, list[str]]:
    """Classes to rank, and the labels among them that were ignored."""
    if request.candidates is None:
        return None, []
    indices: dict[int, None] = {}
    dropped = []
    for place, label in enumerate(request.candidates):
        index = model.vocabulary.index(label)
        if index is not None:
            indices[index] = None
        elif request.unknown_labels == "ignore":
            dropped.append(label)
        else:
            unknown_label(model.vocabulary, label, ("candidates", place), faults)
    return list(indices), dropped


def _place(
    request: MissingRequest, model: ServedModel, reading: Reading, faults: Faults
) -> tuple[str, int] | None:
    if request.at is None:
        return None
    canonical = model.artifact.manifest.vocabulary.relations
    if request.at.relation not in {*canonical, *map(opposite, canonical)}:
        faults.add(Reason.INVALID, ("at", "relation"), "the model does not know this relation")
    anchor = reading.names.find(request.at.object, ("at", "object"), faults)
    return None if anchor is None else (request.at.relation, anchor)


def _check_context(request: GenerateRequest, model: ServedModel) -> None:
    faults = Faults()
    for layer, units in (request.context or {}).items():
        size = model.context_sizes.get(layer)
        if size is None:
            layers = tuple(model.context_sizes)
            faults.add(Reason.INVALID, ("context", layer), "the model has no such layer", layers)
            continue
        for place, unit in enumerate(units):
            if unit >= size:
                message = f"the layer has units 0 to {size - 1}"
                faults.add(Reason.INVALID, ("context", layer, place), message)
    faults.raise_any()
