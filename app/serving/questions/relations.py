"""The route of the question `relations`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from app import questions
from app.questions.ranking import significant
from app.registry import Artifact
from app.scene.relations import canonicalise, opposite
from app.scene.scene import Scene
from app.serving.answers import RELATION_BYTES, Answer, envelope, require_size, rounded
from app.serving.errors import InvalidRequestError, Location
from app.serving.questions.question import BEDROOM, LABELS, REFUSED, SCENES, Example, Question
from app.serving.reading import Faults, Reading
from app.serving.request import Request
from scene_client.schemas import RelationsAnswer, RelationsRequest


async def relations(request: Request, asked: RelationsRequest) -> Answer:
    """Rank the relations between the objects of a scene, most probable first.

    The answer also lists disagreements: pairs of objects whose observed relation differs from the
    relation that the model expects from the rest of the scene.
    """
    model, reading = await request.read(asked)
    found, disagreements = await request.ask(
        model,
        "relations",
        questions.relations,
        reading.scene,
        top_k=asked.top_k,
        # This threshold is slightly lower than the requested minimum, because the final comparison
        # below uses rounded probabilities.
        min_probability=asked.min_probability * (1 - 1e-5),
        pairs=None if asked.pairs is None else _pairs(asked, reading),
        include_opposites=asked.include_opposites,
    )
    require_size(_size(found, disagreements), reading, request.limits.answer_bytes, "top_k")
    answer = envelope(asked, request.id, model.reference, reading)
    ids = reading.ids
    probabilities = significant([entry.probability for entry in found])
    answer["relations"] = [
        {
            "subject": ids[x],
            "relation": relation,
            "object": ids[y],
            "probability": probability,
            "observed": observed,
        }
        for (x, relation, y, _, observed), probability in zip(found, probabilities, strict=True)
        if probability >= asked.min_probability
    ]
    answer["disagreements"] = [_disagreement(entry, reading) for entry in disagreements]
    return answer


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
            faults.add(
                InvalidRequestError, location, "subject and object must be two different objects"
            )
            continue
        pairs[subject, other] = None
    faults.raise_any()
    return list(pairs)


def _size(
    found: Sequence[questions.RelationAnswer], disagreements: Sequence[questions.Disagreement]
) -> Callable[[int], int]:
    entries = len(found) + 2 * len(disagreements)
    return lambda name: entries * (RELATION_BYTES + 2 * name)


def _disagreement(entry: questions.Disagreement, reading: Reading) -> Answer:
    """Return a disagreement with the subject and the object of the relation in the request."""
    subject, object_, observed, expected, probability, observed_probability = entry
    triples = {canonicalise(subject, relation, object_) for relation in observed}
    # The set contains True if the request states an observed relation with this subject, and False
    # if the request states the opposite relation. `flipped` contains the triples stated by their
    # opposite.
    from_here = {(triple[1] == subject) != (triple in reading.flipped) for triple in triples}
    if from_here == {False} and reading.flipped:
        subject, object_ = object_, subject
        observed, expected = tuple(map(opposite, observed)), opposite(expected)
    ids = reading.ids
    return {
        "subject": ids[subject],
        "object": ids[object_],
        "observed": list(observed),
        "expected": expected,
        "probability": rounded(probability),
        "observed_probability": rounded(observed_probability),
    }


def _warm_up(artifact: Artifact, scenes: tuple[Scene, ...]) -> list[float]:
    answers = [questions.relations(artifact, scene) for scene in scenes]
    return [entry.probability for both in answers for found in both for entry in found]


_EXAMPLES: Final = {
    **SCENES,
    "instances": Example(
        "two instances of one class",
        {"objects": ["chair", "chair", "desk"], "top_k": 10},
    ),
    "pairs": Example(
        "all eight relations of one ordered pair of objects",
        {
            **BEDROOM,
            "pairs": [{"subject": "lamp_1", "object": "bed"}],
            "include_opposites": True,
        },
    ),
    "likely": Example(
        "relations with p of at least 0.5; unlisted relations do not hold",
        {**BEDROOM, "relations_complete": True, "min_probability": 0.5},
    ),
    **REFUSED,
    "invalid-request": Example(
        "a pair with an object that is not in the scene",
        {**LABELS, "pairs": [{"subject": "lamp", "object": "desk"}]},
        "invalid-request",
    ),
}
_EXAMPLE_ANSWER: Final = {
    "relations": [
        {
            "subject": "lamp_1",
            "relation": "on-top",
            "object": "nightstand_1",
            "probability": 0.83,
            "observed": True,
        },
        {
            "subject": "nightstand_1",
            "relation": "left",
            "object": "bed",
            "probability": 0.41,
            "observed": False,
        },
    ],
    "disagreements": [
        {
            "subject": "lamp_1",
            "object": "bed",
            "observed": ["on-top"],
            "expected": "left",
            "probability": 0.36,
            "observed_probability": 0.02,
        }
    ],
}

RELATIONS: Final = Question(
    relations,
    _warm_up,
    RelationsRequest,
    RelationsAnswer,
    _EXAMPLES,
    _EXAMPLE_ANSWER,
)
