"""The question `where`: in which room is such a thing, and where in the room?

The answer assumes one such thing. l_r are the calibrated log-odds of `/missing` that room r has it,
given the objects and the type of the room. Then

    p(room r | it is in one of the rooms) = softmax_r(slope·l_r)
    p(it is in one of the rooms) = sigmoid(intercept + here·log sum_r exp(l_r))

with the coefficients of `WhereFit`. Within the room, it is on, in or under an object, or in the
rest of the room. With the log-odds q_k of the placements of `/missing`, the weight of place k is
exp(place_intercept + place_slope·q_k), and that of the rest is 1. With the default coefficients,
these are the probabilities of independent places given that at most one is right. Several objects
of a class share the weight of their place equally.

A listed thing of the class, or of a kind of it, is the wanted thing with the probability `real` of
`app.questions.doubt`, at most `_MOST_CERTAIN`. A listed thing of a broader class counts with the
share `_BROADER`. The hidden places share the probability that no listed thing is it.

A place that the robot has searched without success keeps the share 1 - `LOOK`·s of its probability,
where s is the share of the place that the robot has seen. Then all probabilities are divided by
their sum.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from app.errors import InvalidRequestError, Location
from app.inference.elementary import softmax
from app.model.calibration import WhereFit
from app.model.scene_model import SceneModel
from app.questions.answer import Fields, named, rounded_number
from app.questions.doubt import believed, doubt
from app.questions.missing import VIEWER
from app.questions.names import ErrorList, Unknown
from app.questions.placements import every_placement
from app.questions.posterior import Posterior, calibrated_missing
from app.questions.question import Example, Options, Question
from app.questions.reading import Reading
from app.scene.scene import Scene
from scene_client.frames import Axes, is_world_fixed, viewer_axes
from scene_client.schemas import HomeRoom, SceneRequest, WhereAnswer, WhereRequest

LOOK: Final = 0.8
"""Probability that a robot that sees the place of a thing detects the thing."""

_MOST_CERTAIN: Final = 0.98  # probability of a listed thing, which may have been carried away
_BROADER: Final = 0.5  # share of the listed chairs that count as the wanted office chair
_LEAST_MISSED: Final = 1e-6
_LEAST_PLACE: Final = 1e-4  # a place is that uncertain at least

NOWHERE: Final = -1
"""Index of the room of a thing that is in no room."""


@dataclass(frozen=True, slots=True)
class Room:
    """A room of a home."""

    name: str
    scene: Scene  # its objects, and its type
    coverage: float | None = None  # listed share of its classes; None: unknown


class Search(NamedTuple):
    """A search without success."""

    room: int  # index of the room
    thing: str | None  # id of the object at which the robot has looked; None: the whole room
    seen: float  # share of the place that the robot has seen


class Spot(NamedTuple):
    """A place, and its weight or probability."""

    room: int  # index of the room, or `NOWHERE`
    weight: float
    fields: Fields  # `relation`, `object`, `is_listed` and `offset` of `scene_client.schemas.Spot`


def where(
    model: SceneModel,
    rooms: Sequence[Room],
    wanted: int,  # class of the thing
    *,
    word: str | None = None,  # the request's word for the class
    searched: Sequence[Search] = (),
    top_k: int = 20,
    axes: Axes = VIEWER,  # see `viewer_axes`
    has_viewer: bool = True,  # whether the viewing direction is known
) -> Fields:
    """Rank the places of one thing, likeliest first.

    Returns:
        The fields of `scene_client.schemas.WhereAnswer`.

    Example:
        >>> labels = {"kitchen": ["fridge", "stove"], "bathroom": ["toilet", "bathtub"]}
        >>> rooms = [
        ...     Room(name, Scene(model.vocabulary.bare_objects(things)))
        ...     for name, things in labels.items()
        ... ]
        >>> where(model, rooms, model.vocabulary.index("toothbrush"))["rooms"][0]["room"]
        'bathroom'
    """
    missed, found = _missed(searched), _spots(model, rooms, wanted, axes, has_viewer=has_viewer)
    spots = [spot._replace(weight=spot.weight * missed(spot)) for spot in found]
    total = sum(spot.weight for spot in spots)
    share = np.zeros(len(rooms) + 1)  # of each room; the last one is `NOWHERE`
    for spot in spots:
        share[spot.room] += spot.weight / total
    places = sorted((spot for spot in spots if spot.room != NOWHERE), key=lambda spot: -spot.weight)
    order = np.argsort(-share[:-1], kind="stable").tolist()
    return named(model.vocabulary.labels[wanted], word) | {
        "places": [
            {
                "room": rooms[spot.room].name,
                "probability": rounded_number(spot.weight / total),
                "is_listed": False,
                **spot.fields,
            }
            for spot in places[:top_k]
        ],
        "rooms": [
            {"room": rooms[row].name, "probability": rounded_number(float(share[row]))}
            for row in order
        ],
        "not_here": rounded_number(float(share[NOWHERE])),
    }


def _missed(searched: Sequence[Search]) -> Callable[[Spot], float]:
    """Return the function of a place that gives the probability that all searches have missed it.

    It is at least `_LEAST_MISSED`, so that many searches exclude nothing.
    """
    factors: dict[tuple[int, str | None], float] = defaultdict(lambda: 1.0)
    for search in searched:
        factors[search.room, search.thing] *= 1.0 - LOOK * search.seen

    def of(spot: Spot) -> float:
        factor = factors[spot.room, None]
        if (thing := spot.fields.get("object")) is not None:
            factor *= factors[spot.room, thing]
        return max(factor, _LEAST_MISSED)

    return of


def _spots(
    model: SceneModel, rooms: Sequence[Room], wanted: int, axes: Axes, *, has_viewer: bool
) -> Iterator[Spot]:
    """Yield all places without searches, and that of no room. The weights have the sum 1."""
    share = _shares_of_listed(model, wanted)
    others, listed = list[Scene](), list[Spot]()
    for row, room in enumerate(rooms):
        scene = room.scene
        classes = np.array([thing.class_index for thing in scene.objects], np.int64)
        is_wanted = share[classes] > 0
        if is_wanted.any():
            posterior = Posterior(model, scene)
            real = doubt(model, posterior, posterior.given_rest()[0]).real * share[classes]
            for number in np.flatnonzero(is_wanted).tolist():
                itself: Fields = {"object": scene.objects[number].id, "is_listed": True}
                listed.append(Spot(row, min(float(real[number]), _MOST_CERTAIN), itself))
            objects = tuple(compress(scene.objects, (~is_wanted).tolist()))
            scene = replace(scene, objects=objects, relations=None)
        others.append(scene)
    hidden = math.prod(1.0 - spot.weight for spot in listed)
    confidence = sum(spot.weight for spot in listed)
    for spot in listed:
        yield spot._replace(weight=(1.0 - hidden) * spot.weight / confidence)
    posteriors = [believed(model, scene) for scene in others]
    fit = model.calibration.where
    log_odds = _log_odds(model, posteriors, rooms, wanted)
    logit = fit.intercept + fit.here * float(np.logaddexp.reduce(log_odds))
    here = hidden * (0.5 + 0.5 * math.tanh(logit / 2))  # tanh cannot overflow
    yield Spot(NOWHERE, hidden - here, {})
    shares = (here * softmax(fit.slope * log_odds)).tolist()
    for row, (posterior, scene, share) in enumerate(zip(posteriors, others, shares, strict=True)):
        placed = every_placement(model, posterior, scene, wanted, axes, has_viewer=has_viewer)
        weights = place_weights(fit, np.array([p for p, _ in placed])).tolist()
        unit = share / (1.0 + math.fsum(weights))
        for weight, (_, alike) in zip(weights, placed, strict=True):
            for fields in alike:
                yield Spot(row, unit * weight / len(alike), fields)
        yield Spot(row, unit, {})


def place_weights(
    fit: WhereFit, p: Float[NDArray[np.float64], "k"]
) -> Float[NDArray[np.float64], "k"]:
    """Return the weights of places with the probabilities p. The rest of the room has 1."""
    p = np.clip(p, _LEAST_PLACE, 1.0 - _LEAST_PLACE)
    return np.exp(fit.place_intercept + fit.place_slope * np.log(p / (1.0 - p)))


def _shares_of_listed(model: SceneModel, wanted: int) -> Float[NDArray[np.float64], "V"]:
    """Return the share of the things of each class that are wanted: 1, `_BROADER` or 0."""
    vocabulary = model.vocabulary
    share = np.where(vocabulary.broader[wanted], _BROADER, 0.0)
    share[vocabulary.broader[:, wanted]] = 1.0
    share[wanted] = 1.0
    share[vocabulary.structure] *= vocabulary.structure[wanted]
    return share


def room_log_odds(
    model: SceneModel, rooms: Sequence[Room], wanted: int
) -> Float[NDArray[np.float64], "rooms"]:
    """Return the calibrated log-odds that each room has a thing that none of them lists."""
    return _log_odds(model, [believed(model, room.scene) for room in rooms], rooms, wanted)


def _log_odds(
    model: SceneModel, posteriors: Sequence[Posterior], rooms: Sequence[Room], wanted: int
) -> Float[NDArray[np.float64], "rooms"]:
    calibration, rows = model.calibration, list[float]()
    for posterior, room in zip(posteriors, rooms, strict=True):
        coverage = calibration.coverage if room.coverage is None else room.coverage
        raw = posterior.absent_log_odds(np.array([wanted]), coverage).astype(np.float64)
        n = posterior.listed
        rows += calibrated_missing(calibration, raw, n, room.coverage).tolist()
    return np.array(rows)


# ----------------------------------------------------------------------------------- the request


def rooms_of(request: WhereRequest) -> list[SceneRequest]:
    """Return each room of a request as a scene, without its type.

    Raises:
        InvalidRequestError: two rooms have the same id.
    """
    errors = ErrorList()
    used: set[str] = set()
    for k, room in enumerate(request.rooms):
        if room.id in used:
            errors.add(InvalidRequestError, ("rooms", k, "id"), "another room has this id")
        used.add(room.id)
    errors.raise_any()
    shared = {name: getattr(request, name) for name in _SHARED}
    return [SceneRequest.model_construct(objects=room.objects, **shared) for room in request.rooms]


def _read(request: WhereRequest, _: SceneModel, readings: Sequence[Reading]) -> Options:
    """Return the keyword arguments of `where` for a request. All rooms share `Reading.unknown`."""
    errors, unknown, rooms = ErrorList(), readings[0].unknown, list[Room]()
    wanted = unknown.resolve(request.label, request.label, ("label",), errors)
    if wanted is None and not errors.by_class:
        unknown.refuse(request.label, ("label",), errors, is_room=False)
    for k, (room, reading) in enumerate(zip(request.rooms, readings, strict=True)):
        room_type = _room_type(room, ("rooms", k, "room_type"), unknown, errors)
        rooms.append(Room(room.id, replace(reading.scene, room_type=room_type), room.coverage))
    searched = _searched(request, readings, errors)
    errors.raise_any()
    view = request.viewpoint
    return {
        "rooms": rooms,
        "wanted": wanted,
        "word": request.label,
        "searched": searched,
        "top_k": request.top_k,
        "axes": viewer_axes(request.frame_id, None if view is None else view.yaw, request.up),
        "has_viewer": view is not None or not is_world_fixed(request.frame_id),
    }


def _room_type(room: HomeRoom, at: Location, unknown: Unknown, errors: ErrorList) -> int | None:
    """Return the room type that a room states, or else the one that its id names, if any."""
    if room.room_type is not None:
        return unknown.resolve(room.room_type, room.room_type, at, errors, is_room=True)
    match = unknown.vocabulary.read(room.id, is_room=True)
    return None if match is None else match.entry


def _searched(
    request: WhereRequest, readings: Sequence[Reading], errors: ErrorList
) -> list[Search]:
    """Return the searches of a request, without those at ignored objects."""
    row_of = {room.id: row for row, room in enumerate(request.rooms)}
    searches: list[Search] = []
    for k, one in enumerate(request.searched):
        row = row_of.get(one.room)
        if row is None:
            message = "no entry of `rooms` has this id"
            errors.add(InvalidRequestError, ("searched", k, "room"), message)
            continue
        name, names = one.object, readings[row].names
        if name is not None and not names.is_ignored(name):
            index = names.find(name, ("searched", k, "object"), errors)
            name = None if index is None else readings[row].scene.objects[index].id
        elif name is not None:
            continue
        searches.append(Search(row, name, one.seen_share))
    return searches


_SHARED: Final = (
    *("frame_id", "up", "units", "extents", "box_origin", "quaternion_order", "viewpoint"),
    *("model", "profile", "unknown_labels"),
)
"""Fields of a request that its scenes share."""

_HOME: Final[dict[str, Any]] = {
    "label": "lamp",
    "rooms": [
        {"id": "office", "objects": ["desk", "chair", "keyboard"]},
        {"id": "bathroom", "objects": ["toilet", "sink"]},
        {
            "id": "bedroom",
            "objects": ["bed", "pillow", {"id": "nightstand_1", "label": "nightstand"}],
        },
    ],
}
_EXAMPLES: Final = {
    "home": Example("three rooms with the objects that the robot has seen", _HOME),
    "searched": Example(
        "the robot has looked at the nightstand and in half of the office",
        {
            **_HOME,
            "searched": [
                {"room": "bedroom", "object": "nightstand_1"},
                {"room": "office", "seen_share": 0.5},
            ],
        },
    ),
    "types": Example(
        "rooms by type, without objects",
        {
            "label": "pillow",
            "rooms": [
                {"id": "room_1", "room_type": "bedroom"},
                {"id": "room_2", "room_type": "bathroom"},
            ],
        },
    ),
    "listed": Example("the robot has seen such a thing", {**_HOME, "label": "pillow"}),
    "unknown-thing": Example(
        "a thing that the model does not know", {**_HOME, "label": "lammp"}, "unknown-labels"
    ),
    "invalid-request": Example(
        "a searched room that is not in the home",
        {**_HOME, "searched": [{"room": "attic"}]},
        "invalid-request",
    ),
    "model-not-found": Example(
        "a model that does not exist", {**_HOME, "model": "nobody@9.9.9"}, "model-not-found"
    ),
}
_EXAMPLE_ANSWER: Final = {
    "label": "lamp",
    "places": [
        {
            "room": "bedroom",
            "probability": 0.42,
            "is_listed": False,
            "relation": "on-top",
            "object": "nightstand_1",
        },
        {
            "room": "office",
            "probability": 0.18,
            "is_listed": False,
            "relation": "on-top",
            "object": "desk",
        },
        {"room": "bedroom", "probability": 0.14, "is_listed": False},
    ],
    "rooms": [
        {"room": "bedroom", "probability": 0.58},
        {"room": "office", "probability": 0.27},
        {"room": "bathroom", "probability": 0.02},
    ],
    "not_here": 0.13,
}

_TEXT: Final = """
Rank the places of one thing in a home, most probable first.

A place is on, in or under an object, or the rest of a room. The probabilities of all places and of
`not_here` sum to one. The answer assumes one such thing. Places that the robot has searched without
success keep a fifth of their probability.
"""


def _ask_all(model: SceneModel, scenes: tuple[Scene, ...]) -> Iterator[Fields]:
    """Yield answers for the warm-up."""
    rooms = [Room(str(k), scene) for k, scene in enumerate(scenes)]
    structure = model.vocabulary.structure
    yield where(model, rooms, int(structure.argmin()))
    yield where(model, rooms, len(structure) - 1, searched=[Search(0, None, 0.5)])


WHERE: Final = Question(
    where,
    _read,
    WhereRequest,
    WhereAnswer,
    _EXAMPLES,
    _EXAMPLE_ANSWER,
    _TEXT,
    _ask_all,
    rooms_of=rooms_of,
)
