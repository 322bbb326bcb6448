"""The question `missing`: which unlisted objects are probably present, and where?

The answers are object classes that the scene does not list (candidates), and their placements
(`app.questions.placements`). Structural classes (floor, wall) are neither candidates nor anchors of
placements. `more` adds listed classes with probably more instances than listed, by the statistics
of counts (`app.model.Counts`).
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from app.errors import InvalidRequestError
from app.inference.elementary import sigmoid
from app.model.scene_model import SceneModel
from app.questions.answer import EXPLAINED, Fields, best, named, reasons, significant
from app.questions.doubt import believed
from app.questions.names import ErrorList
from app.questions.placements import Place, place_log_p, placements
from app.questions.posterior import (
    LEAST_CHANGE,
    Posterior,
    Present,
    calibrated_missing,
    log_odds_of,
)
from app.questions.question import LABELS, REFUSED, SCENES, Example, Options, Question
from app.questions.reading import Reading
from app.scene.scene import Scene
from app.scene.spatial_relations import CANONICAL, opposite
from scene_client.frames import Axes, is_world_fixed, viewer_axes
from scene_client.schemas import Anchor, MissingAnswer, MissingRequest

VIEWER = viewer_axes()  # axes of a viewer who looks along the x axis of the frame

Indices = NDArray[np.int64]
Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

LIKELY: Final = 0.5  # minimum probability of further instances at which an answer contains a class

_BLOCK: Final = 32
_OUTSIDE: Final = 0.1  # probability of a count below `low`, and of a count above `high`
_FIELDS: Final = ("listed_count", "expected_count", "low", "high", "probability")


def missing(
    model: SceneModel,
    scene: Scene,
    *,
    top_k: int = 10,  # maximum of classes in each list
    candidates: Sequence[int] | None = None,  # class indices; None: all classes
    listed_as: Mapping[int, str] = MappingProxyType({}),  # the request's words for candidates
    at: tuple[str, int] | None = None,  # a place: (relation, index of the anchor object)
    coverage: float | None = None,  # listed share of the classes of the scene; None: unknown
    axes: Axes = VIEWER,  # see `viewer_axes`
    has_viewer: bool = True,  # whether the viewing direction is known
    details: bool = True,  # whether the answer contains `placements` and `because`
) -> Fields:
    """Rank the unlisted classes by the probability that they are present, likeliest first.

    The model assumes that the scene lists the share `coverage` of its classes. A lower coverage
    gives unlisted classes higher probabilities. Each class is judged separately, so the
    probabilities do not sum to 1. The list `missing` never contains listed or structural classes.
    A listed kind lists its broader classes: a listed office chair is a chair. The list contains a
    kind of a listed class only if `candidates` names this kind, because an office chair may be the
    listed chair itself. Of two classes of one family, the list has the likelier.

    With ``at``, `probability` is the probability that the class is present *and* has this relation
    to the anchor. At a coverage of 1, at most one class is missing. Without a coverage, the base
    rates are those of the model's coverage, and the calibration is that of lists of any share.

    Returns:
        The fields `coverage`, `missing` and `more` of `scene_client.schemas.MissingAnswer`.

    Example:
        >>> scene = Scene(model.vocabulary.bare_objects(["desk", "chair"]))
        >>> missing(model, scene, at=("on-top", 0))["missing"][0]["label"]
        'laptop'
    """
    place = None if at is None else Place.of(*at)
    posterior = believed(model, scene)
    calibration = model.calibration
    classes, log_odds, placed = _ranked(model, posterior, top_k, candidates, place, coverage)
    labels = model.vocabulary.labels
    columns = classes.tolist(), significant(sigmoid(log_odds)), significant(log_odds)
    entries: list[Fields] = []
    for index, probability, value in zip(*columns, strict=True):
        entry = named(labels[index], listed_as.get(index))
        entry["probability"], entry["log_odds"] = probability, value
        entries.append(entry)
    if details and entries:
        places = placements(model, posterior, scene, classes, axes, place, has_viewer=has_viewer)
        for entry, class_places in zip(entries, places, strict=True):
            entry["placements"], entry["because"] = class_places, []
        if place is not None:
            for entry, p in zip(entries, significant(placed), strict=True):
                for requested in entry["placements"][:1]:  # the requested place is the first
                    requested["probability"] = p
        if len(posterior.present.classes):
            explained = classes[:EXPLAINED]
            change = model.objects.reasons_for_absent(posterior.context, scene.profile, explained)
            slope = (calibration.missing if coverage is None else calibration.covered).slope
            causes = reasons(scene, posterior.present, change, least=LEAST_CHANGE, scale=slope)
            for entry, because in zip(entries, causes, strict=False):
                entry["because"] = because
    further: list[Fields] = []
    if at is None:
        further = more(
            model, scene, posterior.present, top_k=top_k, candidates=candidates, coverage=coverage
        )
    used_coverage = calibration.coverage if coverage is None else coverage
    return {"coverage": used_coverage, "missing": entries, "more": further}


def more(
    model: SceneModel,
    scene: Scene,
    listing: Present,
    *,
    top_k: int = 10,
    candidates: Collection[int] | None = None,  # listed at any probability; None: see `LIKELY`
    coverage: float | None = None,  # probability that the request lists an object of the scene
) -> list[Fields]:
    """Return the listed classes with probably more instances than listed, likeliest first.

    Listed objects count as present, whatever their confidence. The answer never contains structural
    classes, classes without statistics, or classes with more listed objects than these cover.

    Only a coverage above that of the model changes the answer. At 1, the scene has no further
    instances.

    Returns:
        The fields of `scene_client.schemas.MoreInstances`. The number of instances is from `low` to
        `high` with a probability of at least 0.8.
    """
    if model.counts is None:
        return []
    # Words without a class have no statistics; their classes follow those of the statistics.
    size = model.vocabulary.trained
    plain = ~model.vocabulary.structure[listing.classes] & (listing.classes < size)
    classes, listed = listing.classes[plain], listing.counts[plain]
    assumed, unlisted = model.calibration.coverage, 1.0
    if coverage is not None and coverage > assumed:
        unlisted = (1 - coverage) / (1 - assumed)
    rows, p = model.counts.distribution(size, classes, listed, scene.room_type, unlisted)
    classes, listed = classes[rows], listed[rows]
    numbers, cumulative = np.arange(1, p.shape[1] + 1), p.cumsum(axis=1)
    p_more = 1 - cumulative[np.arange(len(p)), listed - 1]
    usable = p_more >= LIKELY if candidates is None else np.isin(classes, list(candidates))
    order = best(p_more, usable, top_k)
    if not len(order):
        return []
    labels, first = model.vocabulary.labels, listing.first[plain][rows][order]
    names = [
        named(labels[index], scene.objects[number].label)
        for index, number in zip(classes[order].tolist(), first.tolist(), strict=True)
    ]
    columns = (
        listed[order].tolist(),
        significant(p[order] @ numbers),
        *(
            ((cumulative[order] < share).sum(axis=1) + 1).tolist()
            for share in (_OUTSIDE, 1 - _OUTSIDE)
        ),
        significant(p_more[order]),
    )
    return [
        name | dict(zip(_FIELDS, values, strict=True))
        for name, *values in zip(names, *columns, strict=True)
    ]


def _ranked(
    model: SceneModel,
    posterior: Posterior,
    top_k: int,
    candidates: Sequence[int] | None,
    place: Place | None,
    coverage: float | None,
) -> tuple[Int[Indices, "k"], Float[Floats, "k"], Float[Floats, "k"]]:
    """Return the likeliest classes, their log-odds (at the place) and p(place | present)."""
    vocabulary, listed = model.vocabulary, posterior.present.classes
    usable = ~vocabulary.structure
    usable[listed] = False
    if candidates is None:
        # A listed chair may be the office chair, so only named candidates are kinds of it.
        usable &= ~vocabulary.related[listed].any(0)
    else:
        requested = np.zeros_like(usable)
        requested[list(candidates)] = True
        usable &= requested & ~vocabulary.broader[listed].any(0)
    if not usable.any():
        return np.zeros(0, np.int64), np.zeros(0), np.zeros(0)
    calibration = model.calibration
    used_coverage = calibration.coverage if coverage is None else coverage
    raw = posterior.absent_log_odds(np.arange(len(usable)), used_coverage).astype(np.float64)
    log_odds = calibrated_missing(calibration, raw, posterior.listed, coverage)
    # Without named candidates, relatives of likelier classes are dropped later, so rank more.
    count = 2 * top_k if candidates is None else top_k
    while True:
        score = log_odds
        if place is not None:
            score = _log_p_at(model, posterior, place, usable, log_odds, count)
        first = best(score, usable, count)
        chosen = np.arange(len(first))
        if candidates is None:
            chosen = _one_of_a_family(vocabulary.related[first[:, None], first])
        if len(chosen) >= top_k or len(first) < count:
            break
        count *= 2
    first = first[chosen[:top_k]]
    if place is None:
        return first, log_odds[first], np.ones(len(first))
    placed = np.exp(score[first] + np.logaddexp(0, -log_odds[first]))
    return first, log_odds_of(score[first]), placed


def _one_of_a_family(related: Bool[Mask, "N N"]) -> Int[Indices, "k"]:
    """Return the indices of ranked classes without relatives (same family) of a better class."""
    left_out = np.zeros(len(related), np.bool_)
    for k in np.flatnonzero(related.any(1)):
        if not left_out[k]:
            left_out[k + 1 :] |= related[k, k + 1 :]
    return np.flatnonzero(~left_out)


def _log_p_at(
    model: SceneModel,
    posterior: Posterior,
    place: Place,
    usable: Bool[Mask, "V"],
    log_odds: Float[NDArray[np.floating[Any]], "V"],
    top_k: int,
) -> Float[Floats, "V"]:
    """Return log p(present and at the place): log p(present) + log p(place | present).

    log p of the relation is at most 0, so the other terms of `PlaceFit` are an upper bound. Blocks
    of candidates are scored in descending order of this bound, until it is below the `top_k`
    largest values. The remaining candidates get -inf. ``log_odds`` are those of presence.
    """
    entry, log_p = model.calibration.at[place.relation], -np.logaddexp(0.0, -log_odds)
    at_most = np.full_like(log_p, entry.intercept)
    if model.places is not None and entry.counts:
        stand_in = model.vocabulary.stand_in
        anchor = int(stand_in[posterior.present.classes[posterior.present.row[place.anchor]]])
        ratio = model.places.log_ratio(place.relation, anchor, outgoing=place.outgoing)
        at_most += entry.counts * ratio[stand_in]
    bound = log_p - np.logaddexp(0.0, -at_most)
    joint = np.full_like(log_p, -np.inf)
    order = np.flatnonzero(usable)
    order = order[np.argsort(-bound[order], kind="stable")]
    for start in range(0, len(order), _BLOCK):
        block = order[start : start + _BLOCK]
        largest = np.sort(joint[order[:start]])[-top_k:]
        if len(largest) == top_k and bound[block[0]] < largest[0]:
            break
        logits = at_most[block] + entry.relation * place_log_p(posterior, block, place)
        joint[block] = log_p[block] - np.logaddexp(0.0, -logits)
    return joint


def _read(request: MissingRequest, model: SceneModel, reading: Reading) -> Options:
    """Return the keyword arguments of `missing` for a request."""
    errors, size = ErrorList(), model.spec.V
    # Only the default of `top_k` may exceed the size of the vocabulary.
    if request.top_k > size and "top_k" in request.model_fields_set:
        message = f"`top_k` must be at most {size}, the size of the vocabulary"
        errors.add(InvalidRequestError, ("top_k",), message)
    candidates, listed_as, at, view = None, dict[int, str](), None, request.viewpoint
    if request.candidates is not None:
        labels_of = reading.unknown.resolve_all(request.candidates, "candidates", errors)
        candidates = list(labels_of)
        listed_as = {index: labels[0] for index, labels in labels_of.items()}
    if request.at is not None:
        at = _at(request.at, model, reading, errors)
    errors.raise_any()
    return {
        "top_k": request.top_k,
        "candidates": candidates,
        "listed_as": listed_as,
        "at": at,
        "coverage": request.coverage,
        "axes": viewer_axes(request.frame_id, None if view is None else view.yaw, request.up),
        "has_viewer": view is not None or not is_world_fixed(request.frame_id),
        "details": request.detail == "full",
    }


def _at(
    at: Anchor, model: SceneModel, reading: Reading, errors: ErrorList
) -> tuple[str, int] | None:
    """Return relation and anchor index of the request's field `at`, or None after an error."""
    canonical = CANONICAL[: model.spec.A]
    if at.relation not in {*canonical, *map(opposite, canonical)}:
        errors.add(InvalidRequestError, ("at", "relation"), "the model does not know this relation")
    anchor = reading.names.find(at.object, ("at", "object"), errors)
    if anchor is not None:
        index = reading.scene.objects[anchor].class_index
        if index is not None and reading.vocabulary.structure[index]:
            message = "the model knows no relations to floor, wall and ceiling"
            errors.add(InvalidRequestError, ("at", "object"), message)
    return None if anchor is None else (at.relation, anchor)


def _ask_all(model: SceneModel, scenes: tuple[Scene, ...]) -> Iterator[Fields]:
    """Yield answers for the warm-up, which together run every loop of the question."""
    related, bare, _ = scenes
    for scene in scenes:
        yield missing(model, scene)
    if len(bare.objects) > 1:
        yield missing(model, bare, at=("on-top", 0))
        yield missing(model, related, at=("under", 0))


_EXAMPLES: Final = {
    **SCENES,
    "at": Example(
        "objects that are missing on the desk",
        {"objects": ["desk", "chair"], "at": {"relation": "on-top", "object": "desk"}},
    ),
    "coverage": Example(
        "a complete list: at most one class is missing", {**LABELS, "coverage": 1.0}
    ),
    "candidates": Example(
        "only these candidates", {**LABELS, "candidates": ["pillow", "sink", "toilet"], "top_k": 3}
    ),
    "words": Example(
        "the robot's own words: the answer has the class as `label` and the word as `listed_as`",
        {"objects": ["bed", "bedside table"], "candidates": ["couch", "trash can"]},
    ),
    "scores": Example(
        "probabilities only, for a fast and short answer", {**LABELS, "detail": "scores"}
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
    "missing": [{
        "label": "pillow", "probability": 0.46, "log_odds": -0.16,
        "placements": [{
            "relation": "on-top", "object": "bed", "probability": 0.91,
            "offset": {
                "mean": {"x": 0.005, "y": 0.012, "z": 0.421},
                "std": {"x": 0.466, "y": 0.491, "z": 0.242}, "scenes": 1089,
            },
        }],
        "because": [
            {"object": "bed", "log_odds_change": 1.7},
            {"object": "lamp_1", "log_odds_change": -0.2},
        ],
    }],
    "more": [{
        "label": "nightstand", "listed_as": "bedside table", "listed_count": 1,
        "expected_count": 1.7, "low": 1, "high": 2, "probability": 0.6,
    }],
}  # fmt: skip

_TEXT: Final = """
Rank the classes that the scene does not list, most probable first, with likely places.

The list `more` contains listed classes that probably have further instances, such as a second
nightstand. It is empty for questions about a place.
"""
MISSING: Final = Question(
    missing, _read, MissingRequest, MissingAnswer, _EXAMPLES, _EXAMPLE_ANSWER, _TEXT, _ask_all
)
