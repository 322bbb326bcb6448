"""The four questions: a request in, a scene to the model, an answer as JSON has it out."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from dataclasses import replace

from app import reasoning
from app.scene.frames import viewer_axes
from app.scene.relations import opposite
from app.serving import answer_size, answers
from app.serving.answers import Answer
from app.serving.errors import Location, Reason
from app.serving.models import ServedModel
from app.serving.reading import Faults, Reading
from app.serving.session import Session
from scene_client.schemas import (
    GenerateRequest,
    MissingRequest,
    OutliersRequest,
    RelationsRequest,
    SceneRequest,
)

DRAWN_SEED_BITS = 53
"""Every JSON reader can hand such a seed back: a double holds it exactly."""


async def relations(session: Session, request: RelationsRequest) -> Answer:
    """How do these objects stand to each other?

    Raises:
        RequestError, UnknownModelError, ModelUnavailableError: see `Session.read`.
        RequestError: the answer would be too large.
        QueueFullError, DeadlinePassedError, DisconnectedError: see `Session.ask`.
    """
    model, reading = session.read(request)
    pairs = _pairs(request, reading)
    found, disagreements = await session.ask(
        model,
        reasoning.relations,
        reading.scene,
        top_k=request.top_k,
        # What is left out is decided by the probability as it is answered: rounded.
        min_probability=request.min_probability * (1 - 1e-5),
        pairs=pairs,
        include_opposites=request.include_opposites,
    )
    _require(session, answer_size.of_relations(found, disagreements, reading), "top_k")
    return answers.relations(
        _envelope(session, request, model, reading),
        found,
        disagreements,
        reading,
        min_probability=request.min_probability,
    )


async def missing(session: Session, request: MissingRequest) -> Answer:
    """What else should be here, and where?

    Raises:
        RequestError, UnknownModelError, ModelUnavailableError: see `Session.read`.
        RequestError: the answer would be too large.
        QueueFullError, DeadlinePassedError, DisconnectedError: see `Session.ask`.
    """
    model, reading = session.read(request)
    if request.candidates is not None:
        reading = replace(reading, unknown=reading.unknown.copy())
    faults = Faults()
    # The default is for vocabularies of any size; a number of one's own is not cut down in silence.
    if request.top_k > len(model.vocabulary) and "top_k" in request.model_fields_set:
        message = f"must not be above {len(model.vocabulary)}, the size of the model's vocabulary"
        faults.add(Reason.INVALID, ("top_k",), message)
    candidates = _candidates(request, model, reading, faults)
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
        coverage=request.coverage,
    )
    _require(session, answer_size.of_missing(found, reading), "top_k")
    coverage = request.coverage
    if coverage is None:
        coverage = model.artifact.calibration.coverage
    return answers.missing(_envelope(session, request, model, reading), coverage, found, reading)


async def outliers(session: Session, request: OutliersRequest) -> Answer:
    """What does not belong here, or stands in the wrong place?

    Raises:
        RequestError, UnknownModelError, ModelUnavailableError: see `Session.read`.
        RequestError: the answer would be too large.
        QueueFullError, DeadlinePassedError, DisconnectedError: see `Session.ask`.
    """
    model, reading = session.read(request)
    found = await session.ask(
        model,
        reasoning.outliers,
        reading.scene,
        sensitivity=request.sensitivity,
        threshold=request.threshold,
    )
    _require(session, answer_size.of_outliers(found, reading), "objects")
    return answers.outliers(_envelope(session, request, model, reading), found, reading)


async def generate(session: Session, request: GenerateRequest) -> Answer:
    """What would a scene like this look like?

    Raises:
        RequestError, UnknownModelError, ModelUnavailableError: see `Session.read`.
        RequestError: the answer would be too large.
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
    _require(session, answer_size.of_generated(drawn, reading), "count")
    return answers.generate(_envelope(session, request, model, reading), seed, drawn)


def _require(session: Session, size: int, parameter: str) -> None:
    answer_size.require(size, session.limits.answer_bytes, parameter)


def _envelope(
    session: Session, request: SceneRequest, model: ServedModel, reading: Reading
) -> Answer:
    return answers.envelope(request, session.request_id, model.reference, reading)


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
    request: MissingRequest, model: ServedModel, reading: Reading, faults: Faults
) -> list[int] | None:
    """Classes to rank."""
    if request.candidates is None:
        return None
    indices: dict[int, None] = {}
    for place, label in enumerate(request.candidates):
        index = model.vocabulary.index(label)
        if index is None:
            index = reading.unknown.resolve(label, label, ("candidates", place), faults)
        if index is not None:
            indices[index] = None
    return list(indices)


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
