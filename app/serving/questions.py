"""The four questions: a request in, a scene to the model, an answer as JSON has it out."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from dataclasses import replace

from app import questions
from app.scene.frames import viewer_axes
from app.scene.relations import opposite
from app.serving import answers
from app.serving.answers import Answer
from app.serving.errors import Location, Reason
from app.serving.models import ServedModel
from app.serving.reading import Faults, Reading
from app.serving.request import Request
from scene_client.schemas import GenerateRequest, MissingRequest, OutliersRequest, RelationsRequest

# Each of the four raises:
#     RequestError, UnknownModelError, ModelUnavailableError: see `Request.read`.
#     RequestError: the answer would be too large.
#     QueueFullError, DeadlinePassedError, DisconnectedError: see `Request.ask`.

DRAWN_SEED_BITS = 53
"""Every JSON reader can hand such a seed back: a double holds it exactly."""


async def relations(request: Request, asked: RelationsRequest) -> Answer:
    """How do these objects stand to each other?"""
    model, reading = request.read(asked)
    found, disagreements = await request.ask(
        model,
        questions.relations,
        reading.scene,
        top_k=asked.top_k,
        # A little lower: the rounded probability decides which relations are left out.
        min_probability=asked.min_probability * (1 - 1e-5),
        pairs=None if asked.pairs is None else _pairs(asked, reading),
        include_opposites=asked.include_opposites,
    )
    size = answers.size_of_relations(found, disagreements)
    answers.require_size(size, reading, request.limits.answer_bytes, "top_k")
    envelope = answers.envelope(asked, request.id, model.reference, reading)
    return answers.relations(
        envelope, found, disagreements, reading, min_probability=asked.min_probability
    )


async def missing(request: Request, asked: MissingRequest) -> Answer:
    """What else should be here, and where?"""
    model, reading = request.read(asked)
    faults = Faults()
    # The default is for vocabularies of any size; a client's own number is never cut silently.
    if asked.top_k > len(model.vocabulary) and "top_k" in asked.model_fields_set:
        message = f"must not be above {len(model.vocabulary)}, the size of the model's vocabulary"
        faults.add(Reason.INVALID, ("top_k",), message)
    candidates = at = None
    if asked.candidates is not None:
        reading = replace(reading, unknown=reading.unknown.copy())
        candidates = _candidates(asked.candidates, model, reading, faults)
    if asked.at is not None:
        at = _place(asked, model, reading, faults)
    if faults.found:
        faults.raise_any()
    viewpoint = asked.viewpoint
    found = await request.ask(
        model,
        questions.missing,
        reading.scene,
        top_k=asked.top_k,
        candidates=candidates,
        at=at,
        axes=viewer_axes(asked.frame_id, None if viewpoint is None else viewpoint.yaw),
        coverage=asked.coverage,
    )
    size = answers.size_of_missing(found)
    answers.require_size(size, reading, request.limits.answer_bytes, "top_k")
    coverage = asked.coverage
    if coverage is None:
        coverage = model.artifact.calibration.coverage
    envelope = answers.envelope(asked, request.id, model.reference, reading)
    return answers.missing(envelope, coverage, found, reading)


async def outliers(request: Request, asked: OutliersRequest) -> Answer:
    """What does not belong here, or stands in the wrong place?"""
    model, reading = request.read(asked)
    found = await request.ask(
        model,
        questions.outliers,
        reading.scene,
        sensitivity=asked.sensitivity,
        threshold=asked.threshold,
    )
    size = answers.size_of_outliers(found)
    answers.require_size(size, reading, request.limits.answer_bytes, "objects")
    envelope = answers.envelope(asked, request.id, model.reference, reading)
    return answers.outliers(envelope, found, reading)


async def generate(request: Request, asked: GenerateRequest) -> Answer:
    """What would a scene like this look like?"""
    model, reading = request.read(asked, may_be_empty=True)
    _check_context(asked, model)
    seed = secrets.randbits(DRAWN_SEED_BITS) if asked.seed is None else asked.seed

    def draw(stop: Callable[[], bool]) -> tuple[questions.GeneratedScene, ...]:
        return questions.generate(
            model.artifact,
            reading.scene,
            count=asked.count,
            seed=seed,
            steps=asked.steps,
            temperature=asked.temperature,
            context=asked.context,
            stop=stop,
        )

    drawn = await request.draw(asked.count, model, "generate", draw)
    size = answers.size_of_generated(drawn)
    answers.require_size(size, reading, request.limits.answer_bytes, "count")
    envelope = answers.envelope(asked, request.id, model.reference, reading)
    return answers.generate(envelope, seed, drawn)


def _pairs(asked: RelationsRequest, reading: Reading) -> list[tuple[int, int]]:
    faults = Faults()
    names = reading.names
    pairs: dict[tuple[int, int], None] = {}
    for place, pair in enumerate(asked.pairs or ()):
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
    labels: list[str], model: ServedModel, reading: Reading, faults: Faults
) -> list[int]:
    """Classes to rank."""
    indices: dict[int, None] = {}
    for place, label in enumerate(labels):
        index = model.vocabulary.index(label)
        if index is None:
            index = reading.unknown.resolve(label, label, ("candidates", place), faults)
        if index is not None:
            indices[index] = None
    return list(indices)


def _place(
    asked: MissingRequest, model: ServedModel, reading: Reading, faults: Faults
) -> tuple[str, int] | None:
    if asked.at is None:
        return None
    canonical = model.artifact.manifest.vocabulary.relations
    if asked.at.relation not in {*canonical, *map(opposite, canonical)}:
        faults.add(Reason.INVALID, ("at", "relation"), "the model does not know this relation")
    anchor = reading.names.find(asked.at.object, ("at", "object"), faults)
    return None if anchor is None else (asked.at.relation, anchor)


def _check_context(asked: GenerateRequest, model: ServedModel) -> None:
    faults = Faults()
    for layer, units in (asked.context or {}).items():
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
