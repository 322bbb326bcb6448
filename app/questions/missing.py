"""The question `missing`: which unlisted objects are probably present, and where?

The answers are object classes that the scene does not list (candidates). A placement is a relation
between a candidate and a listed object, called the anchor. An offset is the distance vector between
the centres of both. Structural classes (floor, wall) are neither candidates nor anchors of
placements.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled
from app.inference.elementary import sigmoid
from app.inference.relations import NO_UNIT
from app.questions.calibration import placed_logits, placement_log_p
from app.questions.posterior import Posterior, posterior
from app.questions.ranking import (
    EXPLAINED,
    Because,
    best,
    entries,
    likeliest_places,
    strongest_reasons,
)
from app.registry.artifact import Artifact
from app.registry.offsets import NOTHING, Offsets, look_up
from app.scene.frames import Axes, viewer_axes
from app.scene.relations import CANONICAL, FRONT, LEFT, ON_TOP, RELATIONS, canonicalise, opposite
from app.scene.scene import Scene

VIEWER = viewer_axes()
"""Axes of a viewer who looks along the x axis of the frame."""

_BLOCK: Final = 32

PLACES: Final = 3
"""Maximum number of placements in the answer for one class."""

_SEEN_FROM_ANCHORS: Final = tuple(map(opposite, RELATIONS))
_UNTURNED: Final = np.eye(3)
_PER_METRE: Final = 1000.0  # answers are rounded to millimetres


class Offset(NamedTuple):
    """Predicted vector from the centre of an anchor to the centre of a missing object, in metres.

    Attributes:
        mean: mean of the vector along x, y and z.
        std: standard deviation of the vector along x, y and z.
        scenes: number of training scenes that contain the two classes in this relation.
    """

    mean: tuple[float, float, float]
    std: tuple[float, float, float]
    scenes: int


class Placement(NamedTuple):
    """A place of a missing object, given by its relation to a listed object.

    Attributes:
        relation: relation from the missing object to the listed object.
        object: index of the listed object in `Scene.objects`.
        probability: probability that the relation holds if the missing object is present.
        offset: vector from the listed object to the missing object, or None if unknown.
    """

    relation: str
    object: int
    probability: float
    offset: Offset | None = None


class MissingAnswer(NamedTuple):
    """An unlisted class and the probability that it is present.

    Attributes:
        label: canonical label of the class.
        probability: probability that the class is present although the scene does not list it. If
            the request names a place, it is the probability that the class is present at this
            place.
        log_odds: log-odds that the class is present, before calibration.
        placements: likeliest places of the class, likeliest first.
        because: listed objects that change the log-odds most, in order of the absolute change.
    """

    label: str
    probability: float
    log_odds: float
    placements: tuple[Placement, ...]
    because: tuple[Because, ...]


def missing(
    artifact: Artifact,
    scene: Scene,
    *,
    top_k: int = 10,
    candidates: Sequence[int] | None = None,
    at: tuple[str, int] | None = None,
    coverage: float | None = None,
    axes: Axes | None = VIEWER,
    details: bool = True,
) -> tuple[MissingAnswer, ...]:
    """Rank the unlisted classes by the probability that they are present, likeliest first.

    The model assumes that a present class is listed with probability `coverage`. If the coverage is
    low, an unlisted class may well be present. Each class is judged separately, so the
    probabilities do not sum to 1. The answer never contains listed or structural classes.

    Args:
        artifact: the model.
        scene: the listed objects, their relations and the room type.
        top_k: maximum number of answers.
        candidates: indices of the classes to rank. Listed and structural classes are ignored. None
            means all classes.
        at: a place, as (relation, index of the anchor object). If set, `probability` is the
            probability that the class is present *and* has this relation to the anchor.
        coverage: probability that a present class is listed. None means the model's value. At 1,
            the model treats the other unlisted classes as absent.
        axes: viewer's axes in the frame of the offsets; see `viewer_axes`. None means that the
            viewing direction is unknown.
        details: whether the answers contain `placements` and `because`.

    Raises:
        ValueError: top_k is below 1, the coverage is outside [0, 1], a candidate is outside the
            vocabulary, the relation is unknown, or the anchor is outside the scene.
    """
    spec, calibration = artifact.spec, artifact.calibration
    if top_k < 1:
        raise ValueError(f"top_k must be at least 1, not {top_k}")
    coverage = calibration.coverage if coverage is None else coverage
    if not 0 <= coverage <= 1:
        raise ValueError(f"coverage must be in [0, 1], not {coverage}")
    place = None if at is None else _place(scene, spec.A, at)
    given = posterior(artifact, scene)
    structure = artifact.vocabulary.structure
    usable = ~structure
    usable[given.present.classes] = False
    absent = np.flatnonzero(usable)
    chosen = np.ones(len(absent), np.bool_)
    if candidates is not None:
        chosen = _chosen(absent, spec.V, candidates)
    if not chosen.any():
        return ()
    log_odds = given.absent_posterior(absent, coverage)
    listed = max(1, int(np.count_nonzero(~structure[given.present.classes])))
    if place is None:
        logits = calibration.missing.log_odds(log_odds, listed)
    else:
        logits = _at_place(artifact, given, place, absent, chosen, log_odds, listed, top_k)
    # The order follows the logits, because probabilities near 0 or 1 may round to the same number.
    where = best(logits, chosen, top_k)
    probabilities = sigmoid(logits[where].astype(np.float64))
    found = absent[where]
    labels = artifact.vocabulary.labels
    standing: Sequence[tuple[Placement, ...]] = [()] * len(found)
    because: Sequence[tuple[Because, ...]] = [()] * len(found)
    if details:
        standing = placements(artifact, given, found, axes, place, scene.relations or ())
        because = _reasons(given, found)
    return tuple(
        entries(
            MissingAnswer,
            [labels[index] for index in found.tolist()],
            probabilities.tolist(),
            log_odds[where].tolist(),
            standing,
            because,
        )
    )


def _at_place(
    artifact: Artifact,
    given: Posterior,
    place: tuple[int, int, bool],
    absent: NDArray[np.int64],
    chosen: NDArray[np.bool_],
    log_odds: NDArray[np.floating[Any]],
    listed: int,
    top_k: int,
) -> NDArray[np.floating[Any]]:
    """Return the logits of p(present) · p(relation to the anchor holds | present), (N,).

    The function scores candidates in blocks, in descending order of p(present). The product is at
    most p(present). So the function stops when p(present) of the next candidate is below the
    `top_k` largest products. The remaining candidates get the logit -inf.
    """
    relation, anchor, outgoing = place
    row = int(given.present.row[anchor])
    there = artifact.calibration.missing.log_odds(log_odds, listed)
    logits = np.full_like(there, -np.inf)
    order = np.flatnonzero(chosen)
    order = order[np.argsort(-there[order], kind="stable")]
    for start in range(0, len(order), _BLOCK):
        some = order[start : start + _BLOCK]
        likeliest = np.sort(logits[order[:start]])[-top_k:]
        if len(likeliest) == top_k and there[some[0]] < likeliest[0]:
            break
        log_p = place_log_p(artifact, given, absent[some], relation, row, outgoing=outgoing)
        logits[some] = placed_logits(artifact.calibration, log_odds[some], log_p, listed)
    return logits


def _reasons(given: Posterior, found: NDArray[np.int64]) -> list[tuple[Because, ...]]:
    """Return the listed objects that change the log-odds of each found class most."""
    if not len(given.present.classes):
        return [()] * len(found)
    explained = found[:EXPLAINED]
    reasons = strongest_reasons(given.present.first, given.reasons_for_absent(explained))
    return reasons + [()] * (len(found) - len(explained))


def _place(scene: Scene, relations: int, at: tuple[str, int]) -> tuple[int, int, bool]:
    """Convert the place in a request to canonical form.

    Returns:
        The index of the canonical relation, the index of the anchor object, and True if the missing
        object is the relation's subject.
    """
    name, anchor = at
    if not 0 <= anchor < len(scene.objects):
        raise ValueError(
            f"anchor {anchor} is not the index of one of the {len(scene.objects)} objects"
        )
    relation, subject, _ = canonicalise("missing", name, "anchor")
    if relation >= relations:
        raise ValueError(
            f"the model does not know the relation {name!r}; it knows only "
            f"{CANONICAL[:relations]} and their opposites"
        )
    return relation, anchor, subject == "missing"


def _chosen(
    absent: NDArray[np.int64], classes: int, candidates: Sequence[int]
) -> NDArray[np.bool_]:
    """Return a bool mask (N,) of the absent classes that are candidates."""
    for index in candidates:
        if not 0 <= index < classes:
            raise ValueError(
                f"candidate {index} is not a class index; class indices are below V = {classes}"
            )
    return np.isin(absent, np.array(candidates, dtype=np.int64))


def place_log_p(
    artifact: Artifact,
    given: Posterior,
    candidates: NDArray[np.int64],
    relation: int,
    anchor: int,
    *,
    outgoing: bool,
) -> NDArray[np.floating[Any]]:
    """Return the calibrated log p(relation to the anchor | candidate is present), (N,).

    Args:
        artifact: the model.
        given: posterior of the scene.
        candidates: (N,) indices of absent classes.
        relation: index of a canonical relation.
        anchor: index of the anchor's class among the classes of the scene.
        outgoing: True if the candidate is the relation's subject, False if the anchor is.
    """
    return placement_log_p(
        artifact.relation_slopes.asked_place[relation],
        given.placed_log_p(candidates, relation, anchor, outgoing=outgoing),
        *(float(given.present.log_counts[anchor]), len(given.present.classes) + 1),
    )


def placements(
    artifact: Artifact,
    given: Posterior,
    candidates: NDArray[np.int64],
    axes: Axes | None,
    at: tuple[int, int, bool] | None = None,
    stated: Collection[tuple[int, int, int]] = (),
) -> list[tuple[Placement, ...]]:
    """Return the likeliest relations of each candidate to the listed objects, likeliest first.

    The candidate is subject or object of the relation. Structural classes (floor, wall) are never
    anchors. If a class has several instances, the first instance is the anchor. If an object stands
    on top of another object, candidates are never placed under the upper object.

    Args:
        artifact: the model.
        given: posterior of the scene.
        candidates: (N,) indices of absent classes.
        axes: viewer's axes, or None; see `offsets_of`.
        at: the place in the request, as returned by `_place`. It comes first in each result, even
            if other places are likelier. None means that the request names no place.
        stated: triples (canonical relation, subject, object) between objects of the scene.
    """
    present = given.present
    anchors = np.flatnonzero(~artifact.vocabulary.structure[present.classes])
    if not len(anchors):
        return [()] * len(candidates)
    forward, backward = given.placement_log_odds(candidates, anchors)
    A, first, asked = forward.shape[1], present.first[anchors].tolist(), -1
    if A > ON_TOP and stated:
        standing = {subject for relation, subject, _ in stated if relation == ON_TOP}
        backward[:, ON_TOP, [thing in standing for thing in first]] = NO_UNIT
    asked_p: NDArray[np.floating[Any]] | None = None
    if at is not None:
        relation, object_, to_it = at
        (found,) = np.nonzero(anchors == present.row[object_])
        if len(found):
            asked = ((0 if to_it else A) + relation) * len(first) + int(found[0])
            row = int(anchors[found[0]])
            asked_p = np.exp(
                place_log_p(artifact, given, candidates, relation, row, outgoing=to_it)
            )
            first[found[0]] = object_
    which, relations, outgoing, anchor, probabilities = likeliest_places(
        *(artifact.relation_slopes.placement, forward, backward, present.log_counts[anchors]),
        *(len(present.classes) + 1, PLACES, asked),
    )
    if asked_p is not None:
        probabilities[:: len(which) // len(candidates)] = asked_p
    offsets: Sequence[Offset | None] = [None] * len(which)
    if artifact.offsets is not None:
        ends = candidates[which], present.classes[anchors[anchor]]
        offsets = offsets_of(artifact.offsets, relations, *ends, outgoing, axes)
    named = zip(relations.tolist(), outgoing.tolist(), strict=True)
    listed = entries(
        Placement,
        [(RELATIONS if out else _SEEN_FROM_ANCHORS)[number] for number, out in named],
        [first[number] for number in anchor.tolist()],
        probabilities.tolist(),
        offsets,
    )
    each = len(listed) // len(candidates)
    return [tuple(listed[k : k + each]) for k in range(0, len(listed), each)]


def offsets_of(
    known: Offsets,
    relation: NDArray[np.int64],
    missing: NDArray[np.int64],
    anchor: NDArray[np.int64],
    outgoing: NDArray[np.bool_],
    axes: Axes | None,
) -> Sequence[Offset | None]:
    """Return the offset from each of n anchors to its missing object, or None if unknown.

    Args:
        known: offsets of the model.
        relation: (n,) indices of canonical relations.
        missing: (n,) class indices of the missing objects.
        anchor: (n,) class indices of the anchors.
        outgoing: (n,) bool, True if the missing object is the relation's subject.
        axes: viewer's axes in the frame of the offsets. None means that the viewing direction is
            unknown. The relations left and front then have no offset. The means of other offsets
            are then vertical.
    """
    ends = (relation, missing, anchor, outgoing)
    if axes is None:
        mean, spread, scenes = _lay(known.tables, *ends, _UNTURNED, False)
    else:
        mean, spread, scenes = _lay(known.tables, *ends, np.array(axes), True)
    counts = scenes.tolist()
    found = entries(Offset, map(tuple, mean.tolist()), map(tuple, spread.tolist()), counts)
    if NOTHING not in counts:
        return found
    return [offset if offset.scenes != NOTHING else None for offset in found]


@compiled
def _lay(
    tables: tuple[NDArray[Any], ...],
    relation: NDArray[np.int64],
    missing: NDArray[np.int64],
    anchor: NDArray[np.int64],
    outgoing: NDArray[np.bool_],
    axes: NDArray[np.float64],
    looking: bool,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Compute the mean (n, 3), standard deviation (n, 3) and number of scenes (n,) of n offsets.

    ``looking`` is False if the viewing direction is unknown. For the other arguments, see
    `offsets_of`.
    """
    subject, other = np.where(outgoing, missing, anchor), np.where(outgoing, anchor, missing)
    offset, scenes = look_up(tables, relation, subject, other)
    n = len(relation)
    mean, spread = np.zeros((n, 3)), np.zeros((n, 3))
    for k in range(n):
        if looking:
            for axis in range(3):
                toward, square = offset[k, axis], offset[k, 3 + axis] ** 2
                for to in range(3):
                    mean[k, to] += axes[axis, to] * toward
                    spread[k, to] += axes[axis, to] ** 2 * square
        else:
            if relation[k] == LEFT or relation[k] == FRONT:
                scenes[k] = NOTHING
            mean[k, 2], spread[k, 2] = offset[k, 2], offset[k, 5] ** 2
            for axis in range(2):
                square = (offset[k, axis] ** 2 + offset[k, 3 + axis] ** 2) / 2
                spread[k, 0] += square
                spread[k, 1] += square
        for axis in range(3):
            value = mean[k, axis] if outgoing[k] else -mean[k, axis]
            # Adding 0.0 turns -0.0 into 0.0.
            mean[k, axis] = np.rint(value * _PER_METRE) / _PER_METRE + 0.0
            spread[k, axis] = (
                max(np.rint(math.sqrt(spread[k, axis]) * _PER_METRE), 1.0) / _PER_METRE
            )
    return mean, spread, scenes
