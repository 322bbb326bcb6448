"""The question `relations`: which relations hold between objects, and which are unexpected?

A disagreement is a pair of objects whose observed relation is not the relation that the rest of the
scene suggests. To find disagreements, the module judges each pair with an observed relation a
second time. It then treats all relations between the two classes as unobserved, in both directions.
Otherwise an observation would be evidence for itself: if left is observed, the model also knows
that front does not hold. The pair is a disagreement if the likeliest of the ten relations is
unobserved and has a probability of at least `EXPECTED`.

The model has relation units between classes. If a class has several instances, a relation of any
instance counts as observed for all instances. Example: one chair is to the left of the table, and
another chair is to the right. Then left and right both count as observed for each chair.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from app.compiling import compiled, inlined
from app.errors import InvalidRequestError, Location
from app.inference.quadrature import NO_UNIT
from app.model.scene_model import SceneModel
from app.questions.answer import Fields, significant
from app.questions.names import ErrorList
from app.questions.placements import supported_objects
from app.questions.posterior import (
    Posterior,
    Present,
    exclusive,
    relation_probability,
)
from app.questions.question import BEDROOM, LABELS, REFUSED, SCENES, Example, Options, Question
from app.questions.ranking import best
from app.questions.reading import Reading
from app.scene.scene import Scene
from app.scene.spatial_relations import (
    CANONICAL,
    ON_TOP,
    SUPPORTS,
    canonicalise,
    opposite,
    relation_names,
)
from scene_client.schemas import RelationsAnswer, RelationsRequest, SceneWarning

EXPECTED = 0.5
"""Minimum probability of the expected relation of a disagreement.

If all relations of a pair are unlikely, the likeliest relation is not a meaningful expectation.
"""

_EXCLUDED = np.float32(-1.0)
"""Evidence that a relation cannot hold."""
_MOST_EXCLUDED = np.float32(0.01)
"""Maximum probability of a relation that cannot hold."""


def relations(
    model: SceneModel,
    scene: Scene,
    *,
    top_k: int = 20,
    min_probability: float = 0.0,
    pairs: Sequence[tuple[int, int]] | None = None,
    include_opposites: bool = False,
) -> Fields:
    """Return the likeliest relations between the objects of a scene, and the disagreements.

    A disagreement is an observed relation of two objects for which the model expects another
    relation. The `probability` of an observed relation is that of its evidence. Its `expected` is
    the probability of the model without this observation. The probability is at most .01 if the
    relation is observed not to hold, or if the boxes or other relations exclude it. Structural
    classes (floor, wall) are left out unless `pairs` contains them.

    Args:
        scene: the objects, their observed relations and the room type.
        top_k: maximum number of relations in the answer. The same limit applies to disagreements.
        min_probability: minimum probability of a relation in the answer. The same limit applies to
            the expected relation of a disagreement.
        pairs: ordered pairs (subject, object) to judge, as indices in `scene.objects`. None means
            all pairs.
        include_opposites: whether the answer also lists opposite relations, such as right(y, x) for
            left(x, y).

    Returns:
        The fields `relations` and `disagreements` of `scene_client.schemas.RelationsAnswer`. The
        likeliest relation comes first. The disagreement with the largest ratio of `probability` to
        `observed_probability` comes first. Entries with equal values are ordered by their indices.
        If the training scenes of the model have no relations, the answer lists observed relations
        only. Then the field `warnings` says so.
    """
    if not scene.objects:
        return {"relations": [], "disagreements": []}
    posterior, A = Posterior(model, scene), model.spec.A
    present, slopes = posterior.present, model.relation_slopes
    judged = _judged(model, present, pairs)
    # This limit is slightly lower than the requested minimum, because the final comparison uses
    # rounded probabilities.
    least = min_probability * (1 - 1e-5)
    table = slopes.relation_given if scene.has_observations else slopes.relation
    log_odds, log_counts, row = posterior.relation_log_odds(), present.log_counts, present.row
    evidence = _evidence(model, posterior, scene)
    subjects, objects, kinds, p, of_model = _likeliest_relations(
        table, log_odds, log_counts, row, judged, evidence, least, include_opposites, top_k
    )
    columns = subjects.tolist(), objects.tolist(), kinds.tolist(), significant(p)
    expected = significant(of_model)
    disagreements = _disagreements(model, scene, posterior, judged, top_k=top_k, least=least)
    names, observed, things = relation_names(A), set(scene.triples), scene.objects
    judges = model.spec.judges_relations
    entries: list[Fields] = []
    for subject, object_, kind, probability, own in zip(*columns, expected, strict=True):
        pair = (subject, object_) if kind < A else (object_, subject)
        is_observed = (kind % A, *pair) in observed
        if probability < min_probability or not (judges or is_observed):
            continue
        entry: Fields = {
            "subject": things[subject].id,
            "relation": names[kind],
            "object": things[object_].id,
            "probability": probability,
            "observed": is_observed,
        }
        if is_observed and judges:
            entry["expected"] = own
        entries.append(entry)
    warnings = [] if judges else [_NO_RELATIONS]
    return {"relations": entries, "disagreements": disagreements, "warnings": warnings}


def _evidence(
    model: SceneModel, posterior: Posterior, scene: Scene
) -> Float[NDArray[np.float32], "A N N"]:
    """Return the evidence about the relations of a scene; see `_likeliest_relations`.

    The probability of an observed relation is multiplied by the confidences of its objects. An
    object on or in one object is not on or in another object.
    """
    A, N, table = model.spec.A, len(scene.objects), scene.relations
    if table is None or not len(table):
        return np.zeros((0, 0, 0), np.float32)
    excluded = np.zeros((len(CANONICAL), N, N), np.bool_)
    excluded[table.relation, table.subject, table.object] = True
    # A stacked relation excludes all other relations of its two objects. Left and front exclude
    # stacked relations.
    holds, (beside, stacked) = table.holding, np.zeros((2, N, N), np.bool_)
    is_stacked = holds.relation >= ON_TOP
    for pairs, rows in ((beside, ~is_stacked), (stacked, is_stacked)):
        pairs[holds.subject[rows], holds.object[rows]] = True
    excluded |= stacked | stacked.T
    excluded[ON_TOP:] |= beside | beside.T
    supported = supported_objects(model, posterior, scene)
    for a in SUPPORTS:
        excluded[a, supported] = True
    evidence = np.where(excluded[:A], _EXCLUDED, np.float32(np.nan))
    confidence = np.array([thing.confidence for thing in scene.objects], np.float32)
    observed = holds.rows(holds.relation < A)
    p = observed.probability * confidence[observed.subject] * confidence[observed.object]
    evidence[observed.relation, observed.subject, observed.object] = p
    return evidence


def _judged(
    model: SceneModel, present: Present, pairs: Sequence[tuple[int, int]] | None
) -> NDArray[np.bool_]:
    """Return a bool mask (N subjects, N objects) of the ordered pairs to judge."""
    size = len(present.row)
    if pairs is None:
        things = ~model.vocabulary.structure[present.classes][present.row]
        return things[:, None] & things & ~np.eye(size, dtype=np.bool_)
    judged = np.zeros((size, size), dtype=np.bool_)
    for subject, object_ in pairs:
        judged[subject, object_] = True
    return judged


def _disagreements(
    model: SceneModel,
    scene: Scene,
    posterior: Posterior,
    judged: NDArray[np.bool_],
    *,
    top_k: int,
    least: float,
) -> list[Fields]:
    """Return the fields of `scene_client.schemas.Disagreement` for each disagreement.

    Disagreements with the largest ratio of `probability` to `observed_probability` come first. If a
    pair has several observed relations, the first of them in `CANONICAL` defines the subject of the
    disagreement. A relation is never expected if the machine has no unit for it. ``judged`` is
    (N, N) bool. The function judges a pair of objects if one of its two orders is True.
    """
    A, present = model.spec.A, posterior.present
    stated = [triple for triple in scene.triples if triple[0] < A]
    if not stated:
        return []
    pairs = _observed_pairs(np.array(stated), present.row, judged, len(present.classes), A)
    subjects, objects, holds, of_classes = pairs
    if not len(subjects):
        return []
    i, j = present.row[subjects], present.row[objects]
    table, least = model.relation_slopes.relation_given, max(least, EXPECTED)
    log_odds, log_counts = posterior.log_odds_apart(i, j), present.log_counts
    chosen, expected, p, observed_p = _disagreeing(
        table, *log_odds, log_counts[i] + log_counts[j], holds, of_classes, least, top_k
    )
    columns = *(part[chosen].tolist() for part in (subjects, objects, holds)), expected.tolist()
    return [
        {
            **_names(scene, A, subject, object_, bits, kind),
            "probability": probability,
            "observed_probability": observed_probability,
        }
        for subject, object_, bits, kind, probability, observed_probability in zip(
            *columns, significant(p), significant(observed_p), strict=True
        )
    ]


def _names(
    scene: Scene,
    A: int,
    subject: int,
    object_: int,
    holds: int,
    expected: int,
) -> Fields:
    """Return the names of a disagreement, from the subject of the relation in the request.

    Args:
        A: number of canonical relations that the machine knows.
        holds: bit set of the observed relations; see `_observed_pairs`.
        expected: number of the expected relation.
    """
    names = relation_names(A)
    observed = [name for bit, name in enumerate(names) if holds >> bit & 1]
    triples = {canonicalise(subject, relation, object_) for relation in observed}
    # A relation comes from this subject if the request states it with this subject, or if the
    # request states its opposite with the other object as subject.
    if all((triple[1] == subject) == (triple in scene.opposites) for triple in triples):
        subject, object_ = object_, subject
        names, observed = tuple(map(opposite, names)), list(map(opposite, observed))
    return {
        "subject": scene.objects[subject].id,
        "object": scene.objects[object_].id,
        "observed": observed,
        "expected": names[expected],
    }


def _read(request: RelationsRequest, _: SceneModel, reading: Reading) -> Options:
    return {
        "top_k": request.top_k,
        "min_probability": request.min_probability,
        "pairs": None if request.pairs is None else _pairs(request, reading),
        "include_opposites": request.include_opposites,
    }


def _pairs(request: RelationsRequest, reading: Reading) -> list[tuple[int, int]]:
    """Return the object indices of the pairs in a request, without pairs of ignored objects."""
    errors, names = ErrorList(), reading.names
    pairs: dict[tuple[int, int], None] = {}
    for position, pair in enumerate(request.pairs or ()):
        location: Location = ("pairs", position)
        if names.is_ignored(pair.subject) or names.is_ignored(pair.object):
            continue
        subject = names.find(pair.subject, (*location, "subject"), errors)
        other = names.find(pair.object, (*location, "object"), errors)
        if subject is None or other is None:
            continue
        if subject == other:
            errors.add(
                InvalidRequestError, location, "subject and object must be two different objects"
            )
            continue
        pairs[subject, other] = None
    errors.raise_any()
    return list(pairs)


@compiled
def _likeliest_relations(
    slopes, log_odds, log_counts, row, judged, evidence, least, opposites, count
):
    """Return the `count` likeliest relations between N objects, likeliest first.

    Args:
        slopes: (A, 3) table of `RelationSlopes`.
        log_odds: (A, n, n) log-odds of the A relations between the n classes of the scene.
        log_counts: (n,) log of the number of instances of each class.
        row: (N,) index of each object's class among the n classes.
        judged: (N, N) bool, True for the ordered pairs of objects to judge.
        evidence: (A, N, N) probability of each observed relation, `_EXCLUDED` for a relation that
            cannot hold, and NaN for other relations. It is empty if the scene shows no relations.
        least: minimum probability of a relation in the result.
        opposites: whether the result also contains opposite relations. The opposite of relation a
            has the number A + a.
        count: maximum number k of relations.

    Returns:
        Five arrays (k,): subjects, objects, relations, probabilities, and the probabilities without
        the evidence.
    """
    (A, n), size = log_odds.shape[:2], len(row)
    counts = np.empty((n, n), log_counts.dtype)
    for i in range(n):
        for j in range(n):
            counts[i, j] = log_counts[i] + log_counts[j]
    log_odds = log_odds.reshape(1, A, n * n)
    p = relation_probability(slopes, log_odds, counts.reshape(-1)).reshape(A, n, n)
    names = 2 * A if opposites else A
    grid, usable = np.zeros((size, size, names), p.dtype), np.zeros((size, size, names), np.bool_)
    expected = np.zeros((size, size, names), p.dtype)
    for x in range(size):
        for y in range(size):
            if judged[x, y]:
                i, j = row[x], row[y]
                for a in range(A):
                    to, back = exclusive(p[a, i, j], p[a, j, i])
                    expected[x, y, a] = to
                    if opposites:
                        expected[x, y, A + a] = back
                    if len(evidence):
                        shown, opposite = evidence[a, x, y], evidence[a, y, x]
                        to = with_evidence(to, shown, opposite)
                        back = with_evidence(back, opposite, shown)
                    grid[x, y, a], usable[x, y, a] = to, to >= least
                    if opposites:
                        grid[x, y, A + a], usable[x, y, A + a] = back, back >= least
    values = grid.reshape(-1)
    indices = best(values, usable.reshape(-1), count)
    pair = indices // names
    of_model = expected.reshape(-1)[indices].astype(np.float64)
    probabilities = values[indices].astype(np.float64)
    return pair // size, pair % size, indices % names, probabilities, of_model


@inlined
def with_evidence(p, evidence, opposite):
    """Return the probability of a relation a(x, y), given the evidence about it and about a(y, x).

    A relation cannot hold in both directions.
    """
    if evidence > _EXCLUDED:
        return evidence
    if opposite > _EXCLUDED:
        return min(p, _MOST_EXCLUDED, max(np.float32(1.0) - opposite, np.float32(0.0)))
    return min(p, _MOST_EXCLUDED) if evidence == _EXCLUDED else p


@compiled
def _observed_pairs(triples, row, judged, classes, relations):
    """Return the pairs of objects with at least one observed relation, and their relations.

    A bit set contains the relations of a pair. Bit a stands for relation a from subject to object.
    Bit A + a stands for relation a from object to subject.

    Args:
        triples: (T, 3) observed relations, each as (relation, subject, object).
        row: (N,) index of each object's class among the n classes.
        judged: (N, N) bool, True for the ordered pairs of objects to judge. The result contains a
            pair if one of its two orders is True.
        classes: number n of classes in the scene.
        relations: number A of canonical relations.

    Returns:
        Four arrays (P,): subject, object, bit set of the relations between these two objects, and
        bit set of the relations between any two objects of their classes.
    """
    size = len(row)
    holds, of_classes = np.zeros((size, size), np.int64), np.zeros((classes, classes), np.int64)
    for t in range(len(triples)):
        a, x, y = triples[t, 0], triples[t, 1], triples[t, 2]
        holds[x, y] |= 1 << a
        holds[y, x] |= 1 << (relations + a)
        of_classes[row[x], row[y]] |= 1 << a
        of_classes[row[y], row[x]] |= 1 << (relations + a)
    columns = np.empty((4, min(len(triples), size * size)), np.int64)
    pairs, forward = 0, (1 << relations) - 1
    for x in range(size):
        for y in range(x + 1, size):
            if holds[x, y] and (judged[x, y] or judged[y, x]):
                # The subject of the pair is the subject of its observed relation with the lowest
                # number. n & -n is the lowest bit of n.
                from_x, from_y = holds[x, y] & forward, holds[y, x] & forward
                y_is_lower = from_y != 0 and (from_y & -from_y) < (from_x & -from_x)
                swapped = from_x == 0 or y_is_lower
                subject, object_ = (y, x) if swapped else (x, y)
                columns[0, pairs], columns[1, pairs] = subject, object_
                columns[2, pairs] = holds[subject, object_]
                columns[3, pairs] = of_classes[row[subject], row[object_]]
                pairs += 1
    return columns[0, :pairs], columns[1, :pairs], columns[2, :pairs], columns[3, :pairs]


@compiled
def _disagreeing(slopes, forward, backward, log_counts, holds, of_classes, least, count):
    """Return the `count` pairs whose observed relations differ most from the expected relation.

    The expected relation of a pair is its likeliest relation. The observed probability is the
    probability of the likeliest observed relation. Pairs are ranked by the probability of the
    expected relation divided by the observed probability. The result contains a pair only if its
    expected relation is not observed between any two objects of its classes.

    Args:
        slopes: (A, 3) table of `RelationSlopes`.
        forward: (A, P) log-odds of the relations from subject to object.
        backward: (A, P) log-odds of the relations from object to subject.
        log_counts: (P,) log of the number of object pairs with these two classes.
        holds, of_classes: (P,) bit sets of the relations of the pair and of its classes; see
            `_observed_pairs`.
        least: minimum probability of an expected relation.
        count: maximum number k of pairs.

    Returns:
        Four arrays (k,): index of the pair, number of the expected relation, probability of the
        expected relation, and observed probability.
    """
    A, P = forward.shape
    to = relation_probability(slopes, forward.reshape(1, A, P), log_counts)[0]
    back = relation_probability(slopes, backward.reshape(1, A, P), log_counts)[0]
    expected, ratio = np.empty(P, np.int64), np.empty(P, np.float64)
    likely, usable = np.empty((2, P), np.float64), np.zeros(P, np.bool_)
    p = np.empty(2 * A, forward.dtype)
    for k in range(P):
        for a in range(A):
            p[a], p[A + a] = exclusive(to[a, k], back[a, k])
        top, observed = -1, np.float64(0.0)
        for name in range(2 * A):
            log_odds = forward[name, k] if name < A else backward[name - A, k]
            if log_odds > NO_UNIT and (top < 0 or p[name] > p[top]):
                top = name
            if holds[k] >> name & 1:
                observed = max(observed, np.float64(p[name]))
        if top >= 0 and not of_classes[k] >> top & 1 and p[top] > observed and p[top] >= least:
            usable[k], expected[k] = True, top
            likely[0, k], likely[1, k] = p[top], observed
            ratio[k] = likely[0, k] / observed
    indices = best(ratio, usable, count)
    return indices, expected[indices], likely[0][indices], likely[1][indices]


_NO_RELATIONS: Final = SceneWarning(
    code="not-judged",
    message="the training scenes of this model have no relations",
    objects=[],
)

_EXAMPLES: Final = {
    **SCENES,
    "instances": Example(
        "two instances of one class", {"objects": ["chair", "chair", "desk"], "top_k": 10}
    ),
    "pairs": Example(
        "all ten relations of one ordered pair of objects",
        {**BEDROOM, "pairs": [{"subject": "lamp_1", "object": "bed"}], "include_opposites": True},
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
            "probability": 0.92,
            "observed": True,
            "expected": 0.83,
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
    _read,
    RelationsRequest,
    RelationsAnswer,
    _EXAMPLES,
    _EXAMPLE_ANSWER,
    description="""
Rank the relations between the objects of a scene, most probable first.

The answer also lists disagreements: pairs of objects whose observed relation differs from the
relation that the model expects from the rest of the scene.
""",
)
