"""The route of the question `generate`."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from typing import Final

from app import questions
from app.registry import Artifact
from app.scene.scene import Scene
from app.serving import answers
from app.serving.errors import InvalidRequestError
from app.serving.models import ServedModel
from app.serving.questions.question import BEDROOM, POSES, REFUSED, Example, Question
from app.serving.reading import Faults
from app.serving.request import Request
from scene_client.schemas import GenerateAnswer, GenerateRequest

DRAWN_SEED_BITS = 53
"""Size in bits of a seed that the service chooses.

A JSON reader may store numbers as doubles. A double represents an integer of 53 bits exactly.
"""

_WARM_UP_STEPS: Final = 1  # one Gibbs sweep compiles all kernels
_UNIT_BYTES = 12  # maximum size in bytes of the number of one hidden unit


async def generate(request: Request, asked: GenerateRequest) -> answers.Answer:
    """Sample scenes that contain the given objects and relations. Equal seeds give equal scenes."""
    model, reading = await request.read(asked, may_be_empty=True)
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
    answers.require_size(_size(drawn), reading, request.limits.answer_bytes, "count")
    answer = answers.envelope(asked, request.id, model.reference, reading)
    answer["seed"] = seed
    answer["scenes"] = [
        {
            "objects": scene.objects,
            "relations": [
                {"subject": subject, "relation": relation, "object": other}
                for subject, relation, other in scene.relations
            ],
            "log_score": answers.rounded(scene.log_score),
            "context": scene.context,
        }
        for scene in drawn
    ]
    return answer


def _check_context(asked: GenerateRequest, model: ServedModel) -> None:
    faults = Faults()
    for layer, units in (asked.context or {}).items():
        size = model.context_sizes.get(layer)
        if size is None:
            layers = tuple(model.context_sizes)
            faults.add(
                InvalidRequestError,
                ("context", layer),
                "the model lacks this hidden layer",
                layers,
            )
            continue
        for place, unit in enumerate(units):
            if unit >= size:
                message = f"the hidden layer has only the units 0 to {size - 1}"
                faults.add(InvalidRequestError, ("context", layer, place), message)
    faults.raise_any()


def _size(drawn: Sequence[questions.GeneratedScene]) -> Callable[[int], int]:
    objects = sum([len(scene.objects) for scene in drawn])
    relations = sum([len(scene.relations) for scene in drawn])
    units = sum([len(layer) for scene in drawn for layer in scene.context.values()])
    fixed = (
        len(drawn) * answers.OBJECT_BYTES + relations * answers.RELATION_BYTES + units * _UNIT_BYTES
    )
    return lambda name: fixed + (objects + 2 * relations) * name


def _warm_up(artifact: Artifact, scenes: tuple[Scene, ...]) -> list[float]:
    drawn = questions.generate(artifact, scenes[0], count=2, seed=0, steps=_WARM_UP_STEPS)
    return [scene.log_score for scene in drawn]


_EXAMPLES: Final = {
    "room": Example("a bedroom", {"room_type": "bedroom", "count": 2, "seed": 7}),
    "evidence": Example(
        "scenes that contain these objects and this relation",
        {**BEDROOM, "count": 2, "seed": 7},
    ),
    "poses": Example("scenes around the objects that the robot sees", {**POSES, "seed": 7}),
    "context": Example(
        "active hidden units (GET /models/{name}/contexts lists all units)",
        {"context": {"h1": [0, 3]}, "seed": 7},
    ),
    "varied": Example(
        "more Gibbs steps and a higher temperature, for more varied scenes",
        {"objects": ["desk"], "steps": 100, "temperature": 1.5, "count": 4, "seed": 7},
    ),
    **REFUSED,
}
_EXAMPLE_ANSWER: Final = {
    "seed": 7,
    "scenes": [
        {
            "objects": ["bed", "nightstand", "lamp"],
            "relations": [{"subject": "lamp", "relation": "on-top", "object": "nightstand"}],
            "log_score": -6.1,
            "context": {"h1": [3, 17]},
        }
    ],
}

GENERATE: Final = Question(
    generate,
    _warm_up,
    GenerateRequest,
    GenerateAnswer,
    _EXAMPLES,
    _EXAMPLE_ANSWER,
    has_batch=False,
)
