"""The question `generate`: draw scenes that contain the objects and relations of the evidence.

The evidence is the scene in the request. A drawn scene has the room type of the evidence, or that
of the stored scene where its chain starts. A Gibbs chain sometimes ends in a state between two
kinds of rooms. The drawn scene is then almost empty, or contains an object that fits neither kind
of room. A scene is drawn again if one of these conditions is met:

- The scene has fewer classes than 95 % of short lists of its room type (`Calibration.smallest`).
- The scene fits its room type worse than 95 % of lists of its length (`Calibration.room_fit`).
- The question `outliers` reports a drawn class as an intruder at the default sensitivity. Classes
  that the request lists do not count.

The lists are random parts of whole rooms (`training.fit.calibrate_rooms`). After `ATTEMPTS`
draws for the same scene, the last draw is accepted in any case.
"""

import secrets
from collections.abc import Callable, Collection, Iterator
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from app.compiling import compiled
from app.errors import AnswerTooLargeError, LocatedError, RareRoomTypeError
from app.inference.chains import (
    ChainState,
    ConditionedChains,
    Conditions,
    CrowdedSceneError,
    random_stream,
)
from app.inference.relation_units import encode
from app.model.possibility import IN, ON, known_share
from app.model.scene_model import SceneModel
from app.questions.answer import Fields, rounded_number
from app.questions.names import ErrorList
from app.questions.outliers import intruders
from app.questions.posterior import Present, present
from app.questions.question import BEDROOM, POSES, REFUSED, Example, Options, Question
from app.questions.reading import Reading
from app.scene.relation_table import Triple
from app.scene.scene import Scene, SceneObject
from app.scene.spatial_relations import CANONICAL, ON_TOP, SUPPORTS, opposite
from scene_client.schemas import GenerateAnswer, GenerateRequest

STEPS: Final = 50
"""Default number of Gibbs sweeps for one drawn scene."""

IMPOSSIBLE: Final = -3.0
"""Log prior at which a drawn support is left out."""

ATTEMPTS: Final = 8
"""Maximum number of draws for one scene."""

# Size in bits of a seed that the service chooses. A double, in which a JSON reader may store it,
# represents such an integer exactly.
_SEED_BITS: Final = 53


def generate(
    model: SceneModel,
    scene: Scene,
    *,
    count: int = 1,  # number of scenes
    seed: int,  # the same seed gives the same scenes
    steps: int = STEPS,  # Gibbs sweeps for each draw
    temperature: float = 1.0,  # of the chains; above 1, the scenes are more varied
    stop: Callable[[], bool] = lambda: False,  # True between two draws: return the scenes so far
) -> Fields:
    """Draw scenes that contain the evidence, by Gibbs chains.

    The chains start at samples that the model stores. Every drawn scene contains all objects and
    relations of the evidence, whatever the confidence of the objects. Relations observed not to
    hold are never drawn. The chain draws all other objects and relations. Structural classes
    (floor, wall) outside the evidence are left out of the answer. Every scene has its own random
    stream, so scene k depends only on the seed and on k. A drawn scene contains one object of each
    class. `staying` removes drawn relations that contradict each other.

    Returns:
        The fields of `scene_client.schemas.GenerateAnswer`. For `log_score`, see
        `ConditionedChains.log_score`. Only scores of the same model, for the same listed classes
        and profile, can be compared.

    Raises:
        AnswerTooLargeError: a drawn scene has too many classes.

    Example:
        >>> scene = Scene(model.vocabulary.bare_objects(["desk"]))
        >>> "desk" in generate(model, scene, seed=1)["scenes"][0]["objects"]
        True
    """
    listing = present(scene, model.spec)
    conditions = Conditions(listing.classes, listing.observed, scene.room_type, scene.profile)
    chains = model.scene_chains.under(conditions, temperature)
    shown = ~model.vocabulary.structure
    shown[conditions.classes] = True
    class_of = [thing.class_index or 0 for thing in scene.objects]
    evidence = {(a, class_of[i], class_of[j]) for a, i, j in scene.triples}
    scenes: list[Fields] = []
    while len(scenes) < count and not stop():
        stream = random_stream(seed, len(scenes))
        try:
            state = draw_plausible(model, chains, scene, steps, stream, stop)
        except CrowdedSceneError as error:
            raise AnswerTooLargeError([LocatedError(("temperature",), str(error))]) from None
        scenes.append(_scene(model, chains, state, shown[state.classes], evidence))
    fields: Fields = {"seed": seed, "scenes": scenes}
    if listed_as := _words(model, scene, listing):
        fields["listed_as"] = listed_as
    return fields


def draw_plausible(
    model: SceneModel,
    chains: ConditionedChains,
    evidence: Scene,
    steps: int,
    stream: np.random.Generator,
    stop: Callable[[], bool] = lambda: False,
) -> ChainState:
    """Draw scenes until one is plausible, `ATTEMPTS` times at most. Return the last one."""
    state = chains.draw(steps, stream)
    for _ in range(ATTEMPTS - 1):
        if is_plausible(model, evidence, state.classes, state.room) or stop():
            break
        state = chains.draw(steps, stream)
    return state


def _words(model: SceneModel, scene: Scene, listing: Present) -> dict[str, str]:
    """Return the words of the evidence that differ from the label of their class, by this label."""
    labels, objects = model.vocabulary.labels, scene.objects
    pairs = zip(listing.classes.tolist(), listing.first.tolist(), strict=True)
    words = {labels[index]: objects[number].label for index, number in pairs}
    return {label: word for label, word in words.items() if word != label}


def _scene(
    model: SceneModel,
    chains: ConditionedChains,
    state: ChainState,
    shown: Bool[NDArray[np.bool_], "n"],
    evidence: set[Triple],
) -> Fields:
    """Return the `GeneratedScene` of a drawn scene, with the ``shown`` classes of its state."""
    labels, room_types = model.vocabulary.labels, model.vocabulary.room_types
    units = np.nonzero(state.r & shown[:, None] & shown)
    a, i, j = units  # relation, and rows of subject and object in `state.classes`
    by_class = np.stack([a, state.classes[i], state.classes[j]], axis=1)
    stay = staying(by_class, state.logits[units], evidence, model.vocabulary.structure)
    stay &= _possible(model, by_class, evidence)
    kept = np.zeros_like(state.r)
    kept[units] = stay
    triples = sorted({*map(tuple, by_class[stay].tolist()), *evidence})
    room = {} if state.room is None else {"room_type": room_types[state.room]}
    return room | {
        "objects": [labels[index] for index in state.classes[shown].tolist()],
        "relations": [_told(model, *triple) for triple in triples],
        "log_score": rounded_number(chains.log_score(state, shown, kept)),
    }


def _told(model: SceneModel, a: int, i: int, j: int) -> Fields:
    """Return the `GeneratedRelation` in the usual words: a bin under a desk."""
    labels, places, stand_in = model.vocabulary.labels, model.places, model.vocabulary.stand_in
    pair = int(stand_in[i]), int(stand_in[j])
    if a == ON_TOP and places is not None and places.means_under(*pair):
        return {"subject": labels[j], "relation": opposite(CANONICAL[a]), "object": labels[i]}
    return {"subject": labels[i], "relation": CANONICAL[a], "object": labels[j]}


def _possible(
    model: SceneModel, triples: Int[NDArray[np.int64], "m 3"], evidence: Collection[Triple]
) -> Bool[NDArray[np.bool_], "m"]:
    """Return which drawn relations the prior of possibility admits, beside those of the evidence.

    The prior counts less for relations that training scenes show, and not for a bin under a desk.
    """
    prior, places = model.possibility, model.places
    admitted = np.ones(len(triples), np.bool_)
    if prior is None or places is None:
        return admitted
    stand_in = model.vocabulary.stand_in.tolist()  # words that have no class
    for row, (a, subject, anchor) in enumerate(triples.tolist()):
        i, j = stand_in[subject], stand_in[anchor]
        is_evidence = (a, subject, anchor) in evidence
        if a not in SUPPORTS or is_evidence or (a == ON_TOP and places.means_under(i, j)):
            continue
        share = places.literal_share(i, j) if a == ON_TOP else 1.0
        things, others = np.array([i]), np.array([j])
        k = known_share(share * places.scenes((a,), things, others)[0, 0, 0])
        c = prior.log_p(model.descriptions[things], model.descriptions[others])[
            ON if a == ON_TOP else IN, 0, 0
        ]
        admitted[row] = (1.0 - k) * c > IMPOSSIBLE
    return admitted


def staying(
    # Distinct triples (relation, subject class, object class).
    units: Int[NDArray[np.int64], "m 3"],
    logits: Float[NDArray[np.floating[Any]], "m"],  # if equal, the smallest triple is tried first
    evidence: Collection[Triple],
    structure: Bool[NDArray[np.bool_], "V"],
) -> Bool[NDArray[np.bool_], "m"]:
    """Select drawn relations that do not contradict each other.

    Relations of the evidence always stay. The function then tries the other relations one by one,
    likeliest first. A tried relation stays if all of these conditions are met:

    - The relations kept so far contain no relation between its two classes. `app.scene.scene`
      also finds at most one relation between two objects.
    - The relation does not close a cycle, such as A left of B, B left of C, C left of A.
    - If the relation is *on-top*, no kept relation places its subject on top of another class.
    - The subject class and the object class differ.
    - Neither class is structural (floor, wall). Training drops relations of structural classes, so
      a drawn relation of such a class has no meaning.
    """
    fixed = np.array(sorted(evidence), dtype=np.int64).reshape(-1, 3)
    order = np.lexsort((*units.T[::-1], -logits))
    possible = (units[:, 1] != units[:, 2]) & ~structure[units[:, 1:]].any(axis=1)
    triples = np.concatenate([fixed, units])
    relation = np.ascontiguousarray(triples[:, 0])
    classes, pairs = np.unique(triples[:, 1:], return_inverse=True)
    stay: NDArray[np.bool_] = _select_consistent(
        relation, pairs.reshape(-1, 2), order[possible[order]], len(fixed), len(classes)
    )
    # A drawn relation that is part of the evidence always stays.
    if evidence:
        shape = len(CANONICAL), len(structure), len(structure)
        stay |= np.isin(np.ravel_multi_index(units.T, shape), np.ravel_multi_index(fixed.T, shape))
    return stay


# Direction of each relation: 1 for left, 2 for front, and 0 (up) for on-top, above and inside.
# Their subjects are higher than their objects, or in their objects.
_DIRECTION: Final = np.array([1, 2, 0, 0, 0])


@compiled
def _select_consistent(relation, ends, order, fixed, count):
    """Select relations that contradict neither the evidence nor each other, as a bool mask (m,).

    Args:
        relation: (fixed + m,) canonical relations. The relations of the evidence come first.
        ends: (fixed + m, 2) indices of the subject and object classes, from 0 to count - 1.
        order: indices from 0 to m - 1 of the drawn relations to try, likeliest first.
        fixed: number of relations in the evidence.
        count: number of classes.
    """
    # reaches[d, x, y] is True if relations of direction d lead from x to y, directly or through
    # other classes.
    reaches = np.zeros((3, count, count), np.bool_)
    related, supported = np.zeros((count, count), np.bool_), np.zeros(count, np.bool_)
    stay = np.zeros(len(relation) - fixed, np.bool_)
    for turn in range(fixed + len(order)):
        e = turn if turn < fixed else fixed + order[turn - fixed]
        x, y, reached = ends[e, 0], ends[e, 1], reaches[_DIRECTION[relation[e]]]
        on_top = relation[e] == ON_TOP
        if turn >= fixed:
            if reached[y, x] or related[x, y] or (on_top and supported[x]):
                continue
            stay[e - fixed] = True
        related[x, y] = related[y, x] = True
        supported[x] |= on_top
        # Each class that leads to x now also leads to y and to all classes after y.
        for k in range(count):
            if k == x or reached[k, x]:
                for z in range(count):  # numba compiles an assignment of arrays in seconds
                    reached[k, z] |= reached[y, z]
                reached[k, y] = True
    return stay


def is_plausible(
    model: SceneModel, evidence: Scene, present: Int[NDArray[np.int64], "n"], room: int | None
) -> bool:
    """Return whether a drawn scene is within its limits and has no intruder but those listed.

    Structural classes among the ``present`` classes count only if the evidence lists them.
    """
    listed = {thing.class_index for thing in evidence.objects}
    is_structure = model.vocabulary.structure
    classes = [index for index in present.tolist() if not is_structure[index] or index in listed]
    if not is_within_limits(model, classes, room):
        return False
    if not classes:
        return True
    labels = model.vocabulary.labels
    objects = [SceneObject(labels[index], labels[index], index) for index in classes]
    drawn = intruders(model, Scene(tuple(objects), room_type=room)).tolist()
    return listed.issuperset(drawn)


def is_within_limits(model: SceneModel, classes: list[int], room: int | None) -> bool:
    """Return whether a scene reaches the minima of its room type: `smallest` and `room_fit`."""
    calibration = model.calibration
    smallest, fits = calibration.smallest or (0,), calibration.room_fit
    # The last entry is for scenes without a room type.
    if len(classes) < smallest[-1 if room is None else min(room, len(smallest) - 1)]:
        return False
    if room is None or not fits:
        return True
    return room_fit(model, classes, room) >= fits[room].of(len(classes))


def room_fit(model: SceneModel, classes: list[int], room: int) -> float:
    """Return how well a scene fits a room type t: log p(v | t) / p(v), plus a constant of t."""
    presence = np.ones(len(classes), np.float32)
    index = np.array(classes, dtype=np.int64)
    context = encode(model.weights, index, presence, np.zeros_like(presence))
    return float(model.objects.room_evidence(context.x[None], index, presence[None])[0, room])


def _read(request: GenerateRequest, model: SceneModel, reading: Reading) -> Options:
    """Return the keyword arguments of `generate` for a request."""
    if (name := request.room_type) is not None and reading.scene.room_type is None:
        errors = ErrorList()
        reading.unknown.refuse(name, ("room_type",), errors, is_room=True)
        errors.raise_any()
    if reading.scene.room_type in model.calibration.rare_rooms:
        message = "the model has too few training scenes of this room type to sample such a room"
        raise RareRoomTypeError([LocatedError(("room_type",), message)])
    return {
        "count": request.count,
        "seed": secrets.randbits(_SEED_BITS) if request.seed is None else request.seed,
        "steps": request.steps or STEPS,
        "temperature": request.temperature,
    }


def _ask_all(model: SceneModel, scenes: tuple[Scene, ...]) -> Iterator[Fields]:
    # One Gibbs sweep compiles all kernels.
    yield generate(model, scenes[0], count=2, seed=0, steps=1)


_EXAMPLES: Final = {
    "room": Example("a bedroom", {"room_type": "bedroom", "count": 2, "seed": 7}),
    "evidence": Example(
        "scenes that contain these objects and this relation", {**BEDROOM, "count": 2, "seed": 7}
    ),
    "poses": Example("scenes around the objects that the robot sees", {**POSES, "seed": 7}),
    "varied": Example(
        "more Gibbs steps and a higher temperature, for more varied scenes",
        {"objects": ["desk"], "steps": 100, "temperature": 1.5, "count": 4, "seed": 7},
    ),
    **REFUSED,
}
_EXAMPLE_ANSWER: Final = {
    "seed": 7,
    "scenes": [{
        "room_type": "bedroom", "objects": ["bed", "nightstand", "lamp"],
        "relations": [{"subject": "lamp", "relation": "on-top", "object": "nightstand"}],
        "log_score": -6.1,
    }],
}  # fmt: skip

GENERATE: Final = Question(
    generate,
    _read,
    GenerateRequest,
    GenerateAnswer,
    _EXAMPLES,
    _EXAMPLE_ANSWER,
    description="""
Sample scenes that contain the given objects and relations. Equal seeds give equal scenes.

A filter draws an implausible scene again, at most seven times. Such a scene has an outlier that the
request does not list, or fewer classes than nearly all lists of its room type. Or its classes fit
the type worse than those of nearly all lists.

The request is refused if the model does not know its room type, with any `unknown_labels`. The same
holds if too few training scenes have this room type (`rare_room_types` of `GET
/models/{name}/vocabulary`).
""",
    ask_all=_ask_all,
    samples=True,
)
