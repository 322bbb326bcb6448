"""The question `relations`: which relations hold between objects, and which are unexpected?

A disagreement is a pair of objects whose observed relation is not the relation that the rest of the
scene suggests. To find it, the module judges the pair a second time without its observations: if
left is observed, the model also knows that front does not hold. The pair is a disagreement if the
likeliest of the ten relations is unobserved and has a probability of at least `EXPECTED`.

The model has relation units between classes. If a class has several instances, a relation of any
instance counts as observed for all instances.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from app.compiling import compiled, inlined
from app.errors import InvalidRequestError, Location
from app.inference.elementary import NO_UNIT
from app.model.scene_model import SceneModel
from app.questions.answer import Fields, best, significant
from app.questions.names import ErrorList
from app.questions.placements import supported_objects
from app.questions.posterior import Posterior, Present, exclusive, relation_probability
from app.questions.question import BEDROOM, LABELS, REFUSED, SCENES, Example, Options, Question
from app.questions.reading import Reading
from app.scene.scene import Scene
from app.scene.spatial_relations import (
    CANONICAL,
    ON_TOP,
    POSSIBLE,
    SUPPORTS,
    canonicalise,
    opposite,
    relation_names,
)
from scene_client.schemas import RelationsAnswer, RelationsRequest, SceneWarning

Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

EXPECTED = 0.5
"""Minimum probability of the expected relation of a disagreement.

If all relations of a pair are unlikely, the likeliest relation is not a meaningful expectation.
"""

_EXCLUDED = np.float32(-1.0)  # evidence that a relation cannot hold
_MOST_EXCLUDED = np.float32(0.01)  # maximum probability of a relation that cannot hold


def relations(
    model: SceneModel,
    scene: Scene,
    *,
    top_k: int = 20,  # maximum of relations, and of disagreements
    min_probability: float = 0.0,  # of a relation, and of the expected one of a disagreement
    pairs: Sequence[tuple[int, int]] | None = None,  # ordered (subject, object); None: all pairs
    include_opposites: bool = False,  # whether to add right(y, x) for left(x, y)
) -> Fields:
    """Return the likeliest relations between the objects of a scene, and the disagreements.

    The `probability` of an observed relation is that of its evidence. Its `expected` is
    the probability of the model without this observation. The probability is at most .01 if the
    relation is observed not to hold, or if the boxes or other relations exclude it. Structural
    classes (floor, wall) are left out unless `pairs` contains them.

    Returns:
        The fields `relations` and `disagreements` of `scene_client.schemas.RelationsAnswer`. The
        likeliest relation comes first. Without `pairs` and opposites, a desk "on top of" a bin is
        a bin under a desk, if people say so. The disagreement with the largest ratio of
        `probability` to `observed_probability` comes first. Entries with equal values are ordered
        by their indices.
        If the training scenes of the model have no relations, the answer lists observed relations
        only. Then the field `warnings` says so.

    Example:
        >>> scene = Scene(model.vocabulary.bare_objects(["lamp", "nightstand"]))
        >>> likeliest = relations(model, scene)["relations"][0]
        >>> likeliest["subject"], likeliest["relation"], likeliest["object"]
        ('lamp', 'on-top', 'nightstand')
    """
    if not scene.objects:
        return {"relations": [], "disagreements": []}
    posterior, A = Posterior(model, scene), model.spec.A
    present, slopes = posterior.present, model.relation_slopes
    judged = _judged(model, present, pairs)
    # This limit is slightly lower than the requested minimum, because the final comparison uses
    # rounded probabilities.
    least = min_probability * (1 - 1e-5)
    table = slopes.relation if posterior.context.observed is None else slopes.relation_given
    log_odds, log_counts, row = posterior.relation_log_odds(), present.log_counts, present.row
    evidence = _evidence(model, posterior, scene)
    subjects, objects, kinds, p, of_model = _likeliest_relations(
        table, log_odds, log_counts, row, judged, evidence, least, include_opposites, top_k
    )
    columns = subjects.tolist(), objects.tolist(), kinds.tolist(), significant(p)
    expected = significant(of_model)
    disagreements = _disagreements(model, scene, posterior, judged, top_k=top_k, least=least)
    names, observed, things = relation_names(A), set(scene.triples), scene.objects
    judges, by_usual_words = model.spec.judges_relations, pairs is None and not include_opposites
    entries: list[Fields] = []
    for subject, object_, kind, probability, own in zip(*columns, expected, strict=True):
        pair = (subject, object_) if kind < A else (object_, subject)
        is_observed = (kind % A, *pair) in observed
        is_excluded = probability <= _MOST_EXCLUDED
        if (
            by_usual_words
            and kind == ON_TOP
            and not is_excluded
            and means_under(model, posterior, *pair)
        ):
            kind, subject, object_ = kind + A, object_, subject
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


def means_under(model: SceneModel, posterior: Posterior, upper: int, lower: int) -> bool:
    """Return whether "upper on top of lower" means lower under upper, as with desk and bin."""
    classes = model.vocabulary.stand_in[posterior.present.classes][posterior.present.row]
    places = model.places
    return places is not None and places.means_under(int(classes[upper]), int(classes[lower]))


def _evidence(
    model: SceneModel, posterior: Posterior, scene: Scene
) -> Float[NDArray[np.float32], "A N N"]:
    """Return p of observed relations, `_EXCLUDED` for impossible ones, and NaN for all others.

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
    observed = table.rows(table.probability >= POSSIBLE).known(A)
    p = observed.probability * confidence[observed.subject] * confidence[observed.object]
    evidence[observed.relation, observed.subject, observed.object] = p
    return evidence


def _judged(
    model: SceneModel, present: Present, pairs: Sequence[tuple[int, int]] | None
) -> Bool[Mask, "N N"]:
    """Return whether to judge each ordered pair of objects."""
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
    judged: Bool[Mask, "N N"],
    *,
    top_k: int,
    least: float,
) -> list[Fields]:
    """Return the fields of `scene_client.schemas.Disagreement` for each disagreement.

    The largest ratio of `probability` to `observed_probability`, that of the likeliest observed
    relation, comes first. A relation is never expected if the machine has no unit for it, or if two
    objects of the same classes have it. A pair is judged if one of its orders is in ``judged``.
    """
    A, row = model.spec.A, posterior.present.row
    if scene.relations is None or not scene.triples:
        return []
    stated = scene.relations.holding.known(A)
    chosen, *grids, holds = _expected_relations(
        model.relation_slopes.relation_given,
        posterior.pair_log_odds(),
        posterior.present.log_counts,
        row,
        judged,
        np.stack([stated.relation, stated.subject, stated.object], axis=1),
        max(least, EXPECTED),
        top_k,
    )
    first, second = np.divmod(chosen, len(row))
    subjects, expected, likely, observed = (grid[first, second] for grid in grids)
    objects = first + second - subjects
    columns = subjects.tolist(), objects.tolist(), expected.tolist()
    probabilities = significant(likely), significant(observed)
    return [
        {
            **_names(scene, A, subject, object_, flags.nonzero()[0].tolist(), kind),
            "probability": probability,
            "observed_probability": observed_probability,
        }
        for subject, object_, kind, flags, probability, observed_probability in zip(
            *columns, holds[subjects, objects], *probabilities, strict=True
        )
    ]


def _names(
    scene: Scene, A: int, subject: int, object_: int, observed_kinds: list[int], expected: int
) -> Fields:
    """Return the names of a disagreement, from the subject of the relation in the request."""
    names = relation_names(A)
    observed = [names[kind] for kind in observed_kinds]
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
    """Return the keyword arguments of `relations` for a request."""
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
            message = "subject and object must be two different objects"
            errors.add(InvalidRequestError, location, message)
            continue
        pairs[subject, other] = None
    errors.raise_any()
    return list(pairs)


@compiled
def _likeliest_relations(
    slopes: Float[NDArray, "A 3"],  # table of `RelationSlopes`
    log_odds: Float[NDArray, "A n n"],  # between the n classes of the scene
    log_counts: Float[NDArray, " n"],  # of the instances of each class
    row: Int[NDArray, " N"],  # class of each object, below n
    judged: Bool[NDArray, "N N"],
    # Probability of each observed relation, `_EXCLUDED` for one that cannot hold, NaN for others.
    evidence: Float[NDArray, "A N N"],  # empty without relations
    least: float,  # minimum probability of a relation in the result
    opposites: bool,  # whether to add opposites: A + a is that of relation a
    count: int,  # maximum number k of relations
) -> tuple[
    Int[NDArray, " k"], Int[NDArray, " k"], Int[NDArray, " k"], Float[NDArray, " k"],
    Float[NDArray, " k"],
]:  # fmt: skip
    """Return the likeliest relations between N objects, likeliest first.

    The results are subjects, objects, relations, probabilities, and probabilities without evidence.
    x and y are objects, and i and j are their classes.
    """
    A, size, p = len(log_odds), len(row), _between_classes(slopes, log_odds, log_counts)
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
def _between_classes(slopes, log_odds, log_counts):
    """Return the probability (A, n, n) of each relation between objects of n classes."""
    A, n = log_odds.shape[:2]
    counts = np.empty((n, n), log_counts.dtype)
    for i in range(n):
        for j in range(n):
            counts[i, j] = log_counts[i] + log_counts[j]  # log of the number of object pairs
    flat = log_odds.reshape(1, A, n * n)
    return relation_probability(slopes, flat, counts.reshape(-1)).reshape(A, n, n)


@compiled
def _expected_relations(
    slopes: Float[NDArray, "A 3"],  # table of `RelationSlopes`
    log_odds: Float[NDArray, "A n n"],  # without the observations of each pair
    log_counts: Float[NDArray, " n"],  # of the instances of each class
    row: Int[NDArray, " N"],  # class of each object, below n
    judged: Bool[NDArray, "N N"],
    stated: Int[NDArray, "T 3"],  # relations that hold: relation, subject, object
    least: float,  # minimum probability of an expected relation
    count: int,  # maximum number k of pairs
) -> tuple[
    Int[NDArray, " k"], Int[NDArray, "N N"], Int[NDArray, "N N"], Float[NDArray, "N N"],
    Float[NDArray, "N N"], Bool[NDArray, "N N 2*A"],
]:  # fmt: skip
    """Return the pairs of objects whose observed relations differ most from the expected one.

    The first result is the number x N + y of each pair (x, y). The others are, for all pairs:
    subject, expected relation, its probability, that of the likeliest observed relation, and the
    observed relations. A + a is the opposite of relation a. The subject s is that of the first
    observed relation, and o is the other object. i and j are classes.
    """
    (A, n), size, p = log_odds.shape[:2], len(row), _between_classes(slopes, log_odds, log_counts)
    holds, of_classes = np.zeros((size, size, 2 * A), np.bool_), np.zeros((n, n, 2 * A), np.bool_)
    for t in range(len(stated)):
        a, x, y = stated[t, 0], stated[t, 1], stated[t, 2]
        holds[x, y, a] = holds[y, x, A + a] = True
        of_classes[row[x], row[y], a] = of_classes[row[y], row[x], A + a] = True
    expected, subject = np.zeros((size, size), np.int64), np.zeros((size, size), np.int64)
    likely, observed = np.zeros((size, size)), np.zeros((size, size))
    ratio, usable = np.zeros(size * size), np.zeros(size * size, np.bool_)
    for x in range(size):
        for y in range(x + 1, size):
            s, o = -1, -1
            for a in range(A):
                if s < 0 and (holds[x, y, a] or holds[y, x, a]):
                    s, o = (x, y) if holds[x, y, a] else (y, x)
            if s < 0 or not (judged[x, y] or judged[y, x]):
                continue
            i, j = row[s], row[o]
            for kind in range(2 * A):
                a = kind % A
                to, back = exclusive(p[a, i, j], p[a, j, i])
                value, logit = (to, log_odds[a, i, j]) if kind < A else (back, log_odds[a, j, i])
                if logit > NO_UNIT and value > likely[x, y]:
                    likely[x, y], expected[x, y] = value, kind
                if holds[s, o, kind]:
                    observed[x, y] = max(observed[x, y], value)
            is_new = not of_classes[i, j, expected[x, y]]
            pair, subject[x, y] = x * size + y, s
            ratio[pair] = likely[x, y] / observed[x, y]
            usable[pair] = is_new and likely[x, y] > observed[x, y] and likely[x, y] >= least
    return best(ratio, usable, count), subject, expected, likely, observed, holds


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


_NO_RELATIONS: Final = SceneWarning(
    code="not-judged", message="the training scenes of this model have no relations", objects=[]
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
            "subject": "lamp_1", "relation": "on-top", "object": "nightstand_1",
            "probability": 0.92, "observed": True, "expected": 0.83,
        },
        {
            "subject": "nightstand_1", "relation": "left", "object": "bed", "probability": 0.41,
            "observed": False,
        },
    ],
    "disagreements": [{
        "subject": "lamp_1", "object": "bed", "observed": ["on-top"], "expected": "left",
        "probability": 0.36, "observed_probability": 0.02,
    }],
}  # fmt: skip

_TEXT: Final = """
Rank the relations between the objects of a scene, most probable first.

The answer also lists disagreements: pairs of objects whose observed relation differs from the
relation that the model expects from the rest of the scene.
"""
RELATIONS: Final = Question(
    relations, _read, RelationsRequest, RelationsAnswer, _EXAMPLES, _EXAMPLE_ANSWER, _TEXT
)
