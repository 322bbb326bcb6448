"""Answers to the scoring questions, compared with the enumerated joint of a small machine."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import pytest
import torch

from app.scene import CANONICAL, OPPOSITES
from tests.enumeration.implied import relation_by_definition
from tests.enumeration.small_machines import Joint, enumerate_joint
from tests.questions.answers import disagreements, missing, outliers, relations
from tests.questions.artifacts import EXACT, LABELS, exact_artifact, scene_of
from training.machines.arrays import machine_of

pytestmark = pytest.mark.usefixtures("without_minimums")

# With 2^15 independent draws, the standard error of a probability is below 0.003. The tolerance of
# log-odds is five times larger, because of their slope near 0 and 1.
DRAWS = 1 << 15
TOLERANCE = 0.01
LOG_ODDS_TOLERANCE = 0.05

# Log-odds that an unlisted class is absent from the list, at the neutral coverage of 1/2. The other
# unlisted classes count as absent.
UNLISTED = math.log(0.5)

# The classes of a scene, and its canonical relations (relation, subject, object).
SCENES = [
    ([0], None),
    ([2], None),
    ([0, 1], None),
    ([0, 1], [(0, 0, 1)]),
    ([1, 2], [(0, 1, 0)]),
    ([0, 1, 2], [(0, 2, 0), (0, 0, 1)]),
]


@pytest.fixture(autouse=True)
def _many_draws(monkeypatch):
    monkeypatch.setattr("training.fit.oracle.evidence.DRAWS", DRAWS)


@dataclass(frozen=True)
class Exact:
    """Conditional probabilities of a machine, as sums over its joint."""

    joint: Joint

    def unit(self, triple):
        """The index of a relation unit, or None if the machine does not have it."""
        e = self.joint.edges
        a, i, j = triple
        match = (e.relation[0] == a) & (e.subject[0] == i) & (e.object[0] == j)
        return int(match.nonzero()) if bool(match.any()) else None

    def states(self, present, observed, off=(), free=None):
        """(N,) bool: the states with exactly these classes, except the free class.

        The triples in `observed` are on and those in `off` are off, if the machine has their units.
        """
        v = self.joint.v > 0
        where = torch.ones(len(v), dtype=torch.bool)
        for k in set(range(v.shape[1])) - {free}:
            where &= v[:, k] == (k in present)
        for triples, is_on in ((observed, True), (off, False)):
            for unit in map(self.unit, triples):
                if unit is not None:
                    where &= (self.joint.r[:, unit] > 0) == is_on
        return where

    def object(self, i, present, observed=()):
        """Log-odds of class i, given the other classes and the relations that do not touch it."""
        rest = [triple for triple in observed if i not in triple[1:]]
        return self.joint.log_odds(self.joint.v[:, i] > 0, self.states(present, rest, free=i))

    def changes(self, i, classes):
        """The change of the log-odds of class i by each other class: a dictionary."""
        return {
            j: self.object(i, classes) - self.object(i, [c for c in classes if c != j])
            for j in set(classes) - {i}
        }

    def relation(self, triple, present, observed=(), off=(), *, implied=True):
        """p(r_e = 1), given the classes and the other observed relations.

        Where relations imply each other, their logits define it, and not the joint.
        """
        if (unit := self.unit(triple)) is None:
            return 0.0
        spec = self.joint.machine.spec
        rest = [other for other in observed if other != triple]
        where = self.states(present, rest, off)
        if spec.G and implied:
            on = torch.zeros(spec.A, spec.V, spec.V)
            for other in rest:
                on[other] = 1.0
            return relation_by_definition(self.joint, unit, where, on)
        return sigmoid(self.joint.log_odds(self.joint.r[:, unit] > 0, where))

    def between(self, i, j, *given, **options):
        """The probability of each relation from class i to class j, made exclusive."""
        p = {}
        for a in range(self.joint.machine.spec.A):
            there, back = (
                self.relation((a, *ends), *given, **options) for ends in ((i, j), (j, i))
            )
            p[CANONICAL[a]] = there / max(1, there + back)
            p[OPPOSITES[CANONICAL[a]]] = back / max(1, there + back)
        return p


def sigmoid(x):
    return 1 / (1 + math.exp(-x))


@cache
def exact_case(name, scale=1.3, room=None):
    artifact = exact_artifact(name, scale)
    return artifact, Exact(enumerate_joint(machine_of(artifact.weights), room))


@pytest.fixture(params=EXACT)
def case(request):
    return exact_case(request.param)


def triples(classes, stated):
    return [(a, classes[i], classes[j]) for a, i, j in stated or ()]


def near(value, artifact, stated, tolerance):
    """Without relations, the local form is exact up to the rounding. Other answers are estimates.

    At exact values, the answers have six significant digits.
    """
    if artifact.spec.form == "local" and not stated:
        return pytest.approx(value, rel=1e-5, abs=1e-9)
    return pytest.approx(value, abs=tolerance)


@pytest.mark.parametrize(("classes", "stated"), SCENES[:5])
def test_missing(case, classes, stated):
    artifact, exact = case
    entries = missing(artifact, scene_of(classes, stated))
    assert {entry.label for entry in entries} == {LABELS[i] for i in {0, 1, 2}.difference(classes)}
    for entry in entries:
        i = LABELS.index(entry.label)
        log_odds = UNLISTED + exact.object(i, classes, triples(classes, stated))
        assert entry.log_odds == near(log_odds, artifact, stated, LOG_ODDS_TOLERANCE)
        assert entry.probability == near(sigmoid(log_odds), artifact, stated, TOLERANCE)


@pytest.mark.parametrize(("classes", "stated"), SCENES[:5])
def test_placements(case, classes, stated):
    """The best three of p(r_e = 1 | the candidate is present), made exclusive.

    The answer leaves out what the observed relations imply for relations of a candidate.
    """
    artifact, exact = case
    observed = triples(classes, stated)
    for entry in missing(artifact, scene_of(classes, stated)):
        i = LABELS.index(entry.label)
        expected = {
            (relation, anchor): p
            for anchor, x in enumerate(classes)
            for relation, p in exact.between(i, x, [*classes, i], observed, implied=False).items()
        }
        best = sorted(expected.values(), reverse=True)[:3]
        probabilities = [place.probability for place in entry.placements]
        assert probabilities == pytest.approx(best, abs=TOLERANCE)
        for place in entry.placements:
            p = expected[place.relation, place.object]
            assert place.probability == pytest.approx(p, abs=TOLERANCE)


@pytest.mark.parametrize("relation", ["left", "right"])
@pytest.mark.parametrize("anchor", [0, 1, 2])
def test_missing_at_a_place(case, relation, anchor):
    artifact, exact = case
    for entry in missing(artifact, scene_of([anchor]), at=(relation, 0)):
        i = LABELS.index(entry.label)
        triple = (0, i, anchor) if relation == "left" else (0, anchor, i)
        p = max(exact.relation(triple, [anchor, i]), math.exp(-30))
        p *= sigmoid(UNLISTED + exact.object(i, [anchor]))
        assert entry.probability == pytest.approx(p, abs=TOLERANCE)


@pytest.mark.parametrize(("classes", "stated"), SCENES[2:])
def test_relations(case, classes, stated):
    """The probability of each relation given the others, made exclusive."""
    artifact, exact = case
    entries = relations(artifact, scene_of(classes, stated), top_k=100)
    assert len(entries) == len(classes) * (len(classes) - 1) * artifact.spec.A
    for entry in entries:
        i, j = classes[entry.subject], classes[entry.object]
        p = exact.between(i, j, classes, triples(classes, stated))[entry.relation]
        assert entry.probability == pytest.approx(p, abs=TOLERANCE)


@pytest.mark.parametrize("complete", [False, True])
@pytest.mark.parametrize(
    ("classes", "stated"), [*SCENES[3:], ([2, 0, 1], [(0, 0, 1), (0, 1, 2), (0, 0, 2)])]
)
def test_disagreements(case, classes, stated, complete):
    """Each pair with a stated relation, judged without all relations of the pair.

    If two relations are about equally likely, either may be the expected relation.
    """
    artifact, exact = case
    scene = scene_of(classes, stated, complete=complete)
    entries = {(d.subject, d.object): d for d in disagreements(artifact, scene, top_k=100)}
    on = triples(classes, stated)
    ends = [(i, j) for i in classes for j in classes if i != j]
    units = [(a, *pair) for a in range(artifact.spec.A) for pair in ends]
    off = [unit for unit in units if unit not in on] if complete else []
    for _, x, y in stated:
        i, j = classes[x], classes[y]
        rest = [[unit for unit in some if {*unit[1:]} != {i, j}] for some in (on, off)]
        expected = exact.between(i, j, classes, *rest)
        observed = {CANONICAL[a] for a, *pair in stated if pair == [x, y]}
        likeliest, seen = max(expected.values()), max(expected[name] for name in observed)
        entry = entries.pop((x, y), None)
        if entry is None:
            assert likeliest < seen + 2 * TOLERANCE
            continue
        assert set(entry.observed) == observed
        assert entry.expected not in observed
        assert entry.probability == pytest.approx(expected[entry.expected], abs=TOLERANCE)
        assert entry.probability == pytest.approx(likeliest, abs=2 * TOLERANCE)
        assert entry.observed_probability == pytest.approx(seen, abs=TOLERANCE)
    assert not entries


def test_small_machines_disagree_with_some_scenes_and_agree_with_others():
    """The test above needs both."""
    cases = [(name, scene) for name in EXACT for scene in SCENES[3:]]
    disagree = {bool(disagreements(exact_artifact(name), scene_of(*s))) for name, s in cases}
    assert disagree == {True, False}


@pytest.mark.parametrize(("classes", "stated"), SCENES)
def test_outliers(case, classes, stated):
    artifact, exact = case
    answer = outliers(artifact, scene_of(classes, stated))
    observed = triples(classes, stated)
    for entry in answer.outliers:
        log_odds = exact.object(classes[entry.object], classes, observed)
        assert entry.log_odds == near(log_odds, artifact, stated, LOG_ODDS_TOLERANCE)
        assert entry.probability == near(sigmoid(-log_odds), artifact, stated, TOLERANCE)
    assert len(answer.misplaced) == len(observed)
    for entry in answer.misplaced:
        ends = classes[entry.subject], classes[entry.object]
        p = exact.relation((CANONICAL.index(entry.relation), *ends), classes, observed)
        assert entry.probability == pytest.approx(1 - p, abs=TOLERANCE)


# Without relations in the local form, reasons are exact. Other reasons come from a mean field,
# which is accurate for weights of 0.6.
REASON_TOLERANCE = 0.15


@pytest.mark.parametrize("name", EXACT)
@pytest.mark.parametrize("threshold", [0.0, 1.0])
def test_reasons(name, threshold):
    """The change of an object's log-odds by each other object."""
    artifact, exact = exact_case(name, scale=0.6)
    classes = [0, 1, 2]
    for entry in outliers(artifact, scene_of(classes), threshold=threshold).outliers:
        changes = exact.changes(classes[entry.object], classes)
        sign = -1 if entry.is_outlier else 1
        # Near zero, a mean field may have the other sign.
        least = 1e-9 if artifact.spec.form == "local" else REASON_TOLERANCE
        strong = {j for j, change in changes.items() if sign * change > least}
        assert {reason.object for reason in entry.because} >= strong
        for reason in entry.because:
            change = changes[reason.object]
            assert reason.log_odds_change == near(change, artifact, None, REASON_TOLERANCE)
            assert sign * reason.log_odds_change > 0
        sizes = [abs(reason.log_odds_change) for reason in entry.because]
        assert sizes == sorted(sizes, reverse=True)


@pytest.mark.parametrize("name", EXACT)
@pytest.mark.parametrize("classes", [[0], [2, 0], [1, 2], [1, 1, 2]])
def test_reasons_for_missing_objects(name, classes):
    """The change by each listed class. The first object of the class stands for it."""
    artifact, exact = exact_case(name, scale=0.6)
    for entry in missing(artifact, scene_of(classes)):
        changes = exact.changes(LABELS.index(entry.label), classes)
        expected = {classes.index(j): change for j, change in changes.items()}
        reasons = {reason.object: reason.log_odds_change for reason in entry.because}
        assert reasons == near(expected, artifact, None, REASON_TOLERANCE)


@pytest.mark.parametrize("name", [name for name in EXACT if EXACT[name].C])
@pytest.mark.parametrize("room", [0, 1])
def test_the_room_type_counts(name, room):
    artifact, exact = exact_case(name, room=room)
    for entry in missing(artifact, scene_of([0], room=room)):
        log_odds = UNLISTED + exact.object(LABELS.index(entry.label), [0])
        assert entry.log_odds == near(log_odds, artifact, None, LOG_ODDS_TOLERANCE)
