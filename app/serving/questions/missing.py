"""The route of the question `missing`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

from app import questions
from app.questions.missing import VIEWER
from app.questions.ranking import significant
from app.registry import Artifact
from app.scene.frames import Axes, viewer_axes
from app.scene.relations import opposite
from app.scene.scene import Scene
from app.serving import answers
from app.serving.errors import InvalidRequestError
from app.serving.models import ServedModel
from app.serving.questions.question import LABELS, REFUSED, SCENES, Example, Question
from app.serving.reading import Faults, Reading
from app.serving.request import Request
from scene_client.schemas import Anchor, MissingAnswer, MissingRequest

_OFFSET_BYTES = 250
_LEAST_SHARE: Final = 0.75  # least probability of a placement, as a share of the first placement
_LEAST_CHANGE: Final = math.log(3)  # substantial evidence: a Bayes factor of at least 3


async def missing(request: Request, asked: MissingRequest) -> answers.Answer:
    """Rank the classes that the scene does not list, most probable first, with likely places.

    The list `more` contains listed classes that probably have further instances, such as a second
    nightstand. It is empty for questions about a place.
    """
    model, reading = await request.read(asked)
    faults = Faults()
    # Only the default of `top_k` may exceed the size of the vocabulary.
    if asked.top_k > len(model.vocabulary) and "top_k" in asked.model_fields_set:
        message = f"`top_k` must be at most {len(model.vocabulary)}, the size of the vocabulary"
        faults.add(InvalidRequestError, ("top_k",), message)
    candidates = at = None
    if asked.candidates is not None:
        candidates = _candidates(asked.candidates, model, reading, faults)
    if asked.at is not None:
        at = _place(asked.at, model, reading, faults)
    if faults.found:
        faults.raise_any()
    found, further = await request.ask(
        model,
        "missing",
        _missing_and_more,
        reading.scene,
        top_k=asked.top_k,
        candidates=candidates,
        at=at,
        axes=_axes(asked),
        coverage=asked.coverage,
        details=asked.detail == "full",
    )
    found = tuple([_notable(entry, reading.scene) for entry in found])
    answers.require_size(_size(found, further), reading, request.limits.answer_bytes, "top_k")
    answer = answers.envelope(asked, request.id, model.reference, reading)
    coverage = asked.coverage
    answer["coverage"] = model.artifact.calibration.coverage if coverage is None else coverage
    answer["missing"] = _entries(found, reading.ids, full=asked.detail == "full")
    answer["more"] = [
        entry._asdict()
        | {
            "expected_count": answers.rounded(entry.expected_count),
            "probability": answers.rounded(entry.probability),
        }
        for entry in further
    ]
    return answer


def _missing_and_more(
    artifact: Artifact, scene: Scene, /, *, axes: Axes | None, details: bool, **asked: Any
) -> tuple[tuple[questions.MissingAnswer, ...], tuple[questions.More, ...]]:
    """Compute both lists of the answer. The list `more` is empty for questions about a place."""
    at = asked.pop("at")
    found = questions.missing(artifact, scene, at=at, axes=axes, details=details, **asked)
    return found, () if at is not None else questions.more(artifact, scene, **asked)


def _notable(entry: questions.MissingAnswer, scene: Scene) -> questions.MissingAnswer:
    """Leave out less likely places, weak reasons, and offsets from objects without a position."""
    places = [
        place if scene.objects[place.object].position is not None else place._replace(offset=None)
        for place in entry.placements
    ]
    least = _LEAST_SHARE * places[0].probability if places else 0.0
    likely = [place for place in places if place.probability >= least]
    because = [one for one in entry.because if abs(one.log_odds_change) >= _LEAST_CHANGE]
    return entry._replace(placements=tuple(likely), because=tuple(because))


def _entries(
    found: Sequence[questions.MissingAnswer], ids: Sequence[str], *, full: bool
) -> list[answers.Answer]:
    """Return the entries of the list `missing`, with rounded numbers."""
    numbers: list[float] = []
    for _, probability, log_odds, placements, because in found:
        numbers += probability, log_odds
        for _, _, share, offset in placements:
            numbers.append(share)
            if offset is not None:
                numbers += offset[0]
                numbers += offset[1]
        numbers += [change for _, change in because]
    numbered = iter(significant(numbers))
    entries: list[answers.Answer] = []
    for label, _, _, placements, because in found:
        entry = {"label": label, "probability": next(numbered), "log_odds": next(numbered)}
        if full:
            entry["placements"] = [_placement(place, ids, numbered) for place in placements]
            entry["because"] = answers.reasons(because, ids, numbered)
        entries.append(entry)
    return entries


def _candidates(
    labels: list[str], model: ServedModel, reading: Reading, faults: Faults
) -> list[int]:
    """Return the class indices of the labels in the request's field `candidates`."""
    indices: dict[int, None] = {}
    for place, label in enumerate(labels):
        index = model.vocabulary.index(label)
        if index is None:
            index = reading.unknown.resolve(label, label, ("candidates", place), faults)
        if index is not None:
            indices[index] = None
    return list(indices)


def _place(
    at: Anchor, model: ServedModel, reading: Reading, faults: Faults
) -> tuple[str, int] | None:
    canonical = model.artifact.manifest.vocabulary.relations
    if at.relation not in {*canonical, *map(opposite, canonical)}:
        faults.add(InvalidRequestError, ("at", "relation"), "the model does not know this relation")
    anchor = reading.names.find(at.object, ("at", "object"), faults)
    return None if anchor is None else (at.relation, anchor)


def _axes(asked: MissingRequest) -> Axes | None:
    """Return the viewer's axes in `frame_id`, or None if the viewing direction is unknown."""
    if asked.frame_id is None and asked.viewpoint is None:
        return VIEWER
    return viewer_axes(asked.frame_id, None if asked.viewpoint is None else asked.viewpoint.yaw)


def _size(
    found: Sequence[questions.MissingAnswer], further: Sequence[questions.More]
) -> Callable[[int], int]:
    places = causes = 0
    for entry in found:
        places += len(entry.placements)
        causes += len(entry.because)
    fixed = places * (answers.RELATION_BYTES + _OFFSET_BYTES) + causes * answers.CAUSE_BYTES
    names = len(found) + len(further)
    fixed += names * answers.OBJECT_BYTES
    return lambda name: fixed + (places + causes + names) * name


def _placement(
    place: questions.Placement, ids: Sequence[str], numbered: Iterator[float]
) -> answers.Answer:
    relation, object_, _, offset = place
    entry: answers.Answer = {
        "relation": relation,
        "object": ids[object_],
        "probability": next(numbered),
    }
    if offset is not None:
        mean = {"x": next(numbered), "y": next(numbered), "z": next(numbered)}
        std = {"x": next(numbered), "y": next(numbered), "z": next(numbered)}
        entry["offset"] = {"mean": mean, "std": std, "scenes": offset.scenes}
    return entry


def _warm_up(artifact: Artifact, scenes: tuple[Scene, ...]) -> list[float]:
    related, bare, _ = scenes
    found = [entry for scene in scenes for entry in questions.missing(artifact, scene)]
    if len(bare.objects) > 1:
        questions.missing(artifact, bare, at=("on-top", 0))
        questions.missing(artifact, related, at=("under", 0))
    numbers = [number for entry in found for number in (entry.probability, entry.log_odds)]
    numbers += [cause.log_odds_change for entry in found for cause in entry.because]
    counted = [entry for scene in scenes for entry in questions.more(artifact, scene)]
    return numbers + [number for e in counted for number in (e.expected_count, e.probability)]


_EXAMPLES: Final = {
    **SCENES,
    "at": Example(
        "objects that are missing on the desk",
        {"objects": ["desk", "chair"], "at": {"relation": "on-top", "object": "desk"}},
    ),
    "coverage": Example(
        "a complete list: unlisted classes count as absent",
        {**LABELS, "coverage": 1.0},
    ),
    "candidates": Example(
        "only these candidates",
        {**LABELS, "candidates": ["pillow", "sink", "toilet"], "top_k": 3},
    ),
    "scores": Example(
        "probabilities only, for a fast and short answer",
        {**LABELS, "detail": "scores"},
    ),
    **REFUSED,
    "invalid-request": Example(
        "a place at an object that is not in the scene",
        {**LABELS, "at": {"relation": "on-top", "object": "desk"}},
        "invalid-request",
    ),
}
_EXAMPLE_ANSWER: Final = {
    "coverage": 0.5,
    "missing": [
        {
            "label": "pillow",
            "probability": 0.46,
            "log_odds": 1.9,
            "placements": [
                {
                    "relation": "on-top",
                    "object": "bed",
                    "probability": 0.91,
                    "offset": {
                        "mean": {"x": 0.005, "y": 0.012, "z": 0.421},
                        "std": {"x": 0.466, "y": 0.491, "z": 0.242},
                        "scenes": 1089,
                    },
                }
            ],
            "because": [
                {"object": "bed", "log_odds_change": 1.7},
                {"object": "lamp_1", "log_odds_change": -0.2},
            ],
        }
    ],
    "more": [
        {
            "label": "nightstand",
            "listed_count": 1,
            "expected_count": 1.7,
            "low": 1,
            "high": 2,
            "probability": 0.6,
        }
    ],
}

MISSING: Final = Question(
    missing,
    _warm_up,
    MissingRequest,
    MissingAnswer,
    _EXAMPLES,
    _EXAMPLE_ANSWER,
)
