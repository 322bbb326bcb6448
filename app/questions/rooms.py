"""The question `rooms`: of which room type is a room with these objects?

For a single object, the answer is where such an object usually is. The answer ignores the room type
of the request. The machine's probability of a room type t (`app.inference.objects`) is calibrated:

    p(t) ∝ p_machine(t | objects)^s,   s = slope + log_count · log(number of listed classes)
"""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from app.inference.elementary import softmax
from app.model.scene_model import SceneModel
from app.questions.answer import Fields, reasons, significant
from app.questions.doubt import room_odds
from app.questions.names import ErrorList
from app.questions.posterior import LEAST_CHANGE
from app.questions.question import BEDROOM, LABELS, REFUSED, SCENES, Example, Options, Question
from app.questions.reading import Reading
from app.scene.scene import Scene
from scene_client.schemas import RoomsAnswer, RoomsRequest, SceneWarning


def rooms(
    model: SceneModel,
    scene: Scene,
    *,
    top_k: int = 5,
    candidates: Mapping[int, Sequence[str]] | None = None,  # names by index; None: all room types
    details: bool = True,  # whether the answer contains `because`
) -> Fields:
    """Rank the room types by their probability, likeliest first.

    The relations and the room type of the scene are not used. The probabilities of the candidates
    sum to 1. Candidates are the rooms of a home, so all are equally likely without objects: their
    log-odds lose log p(t) of an empty scene. `scene_client.schemas.RoomsAnswer` defines the fields.
    If the model has no room types, the list is empty, with a warning.

    Example:
        >>> scene = Scene(model.vocabulary.bare_objects(["bed", "nightstand"]))
        >>> rooms(model, scene)["room_types"][0]["room_type"]
        'bedroom'
    """
    C = model.spec.C
    among = np.arange(C) if candidates is None else np.array([*candidates], dtype=np.int64)
    if not len(among):
        return {"warnings": [] if C else [_NO_ROOM_TYPES], "room_types": []}
    posterior, log_p, change = room_odds(model, scene, explained=details)
    sharpness = model.calibration.rooms.of(posterior.listed)
    if candidates is not None:
        is_plain = scene.profile is None
        empty = model.room_prior if is_plain else model.empty_room_log_p(scene.profile)
        log_p = log_p - empty
    p = softmax(sharpness * log_p[among])
    first = np.argsort(-p, kind="stable")[:top_k]
    entries: list[Fields] = []
    for t, probability in zip(among[first].tolist(), significant(p[first]), strict=True):
        name = model.vocabulary.room_types[t]
        entries.append({"room_type": name, "probability": probability})
        if candidates is not None and candidates[t] != [name]:
            entries[-1]["listed_as"] = candidates[t]
    if change is not None:
        of_entries = change[among[first]]
        causes = reasons(scene, posterior.present, of_entries, least=LEAST_CHANGE)
        for entry, because in zip(entries, causes, strict=True):
            entry["because"] = because
    return {"room_types": entries}


def _read(request: RoomsRequest, _: SceneModel, reading: Reading) -> Options:
    """Return the keyword arguments of `rooms` for a request."""
    candidates = None
    if request.candidates is not None:
        errors = ErrorList()
        names = request.candidates
        candidates = reading.unknown.resolve_all(names, "candidates", errors, is_room=True)
        errors.raise_any()
    details = request.detail == "full"
    return {"top_k": request.top_k, "candidates": candidates, "details": details}


_NO_ROOM_TYPES: Final = SceneWarning(
    code="not-judged", message="the training scenes of this model have no room types", objects=[]
)

_EXAMPLES: Final[dict[str, Any]] = {
    "labels": Example("which room is this?", LABELS),
    "object": Example("where is such an object usually?", {"objects": ["keyboard"]}),
    "candidates": Example(
        "only the rooms of this flat",
        {"objects": ["desk", "lamp"], "candidates": ["bedroom", "bathroom", "office"], "top_k": 2},
    ),
    "one-type": Example(
        "two names of one room type",
        {"objects": ["pillow"], "candidates": ["toilet", "bathroom", "bedroom"]},
    ),
    "scores": Example(
        "probabilities only, for a fast and short answer", {**LABELS, "detail": "scores"}
    ),
    "relations": Example("relations and the room type of the request are not used", BEDROOM),
    **{name: SCENES[name] for name in ("poses", "ignore", "nearest", "training")},
    **REFUSED,
    "unknown-room-type": Example(
        "a candidate that the model does not know",
        {**LABELS, "candidates": ["bedroom", "engine room"]},
        "unknown-labels",
    ),
}
_EXAMPLE_ANSWER: Final = {
    "room_types": [
        {
            "room_type": "bedroom",
            "probability": 0.93,
            "because": [
                {"object": "bed", "log_odds_change": 3.9},
                {"object": "nightstand", "log_odds_change": 1.4},
            ],
        },
        {"room_type": "living room", "probability": 0.02, "because": []},
    ],
}

_TEXT: Final = """
Rank the room types by their probability given the objects, most probable first.

For a single object, the answer is where such an object usually is. The probabilities of all room
types, or of all candidates, sum to one. Candidates that name one room type, such as toilet and
bathroom, share one entry and its probability. The entry lists these names in `listed_as`. The
answer uses neither relations nor the room type of the request.
"""
ROOMS: Final = Question(rooms, _read, RoomsRequest, RoomsAnswer, _EXAMPLES, _EXAMPLE_ANSWER, _TEXT)
