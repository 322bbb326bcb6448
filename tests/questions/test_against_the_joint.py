"""Every scoring answer against the enumerated joint of a small machine."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest
import torch

from app.scene import CANONICAL, OPPOSITES
from tests.enumeration.implied import relation_by_definition
from tests.enumeration.small_machines import Joint, enumerate_joint
from tests.questions.answers import missing, outliers, relations
from tests.questions.artifacts import EXACT, LABELS, exact_artifact, scene_of
from training.machines.arrays import machine_of

pytestmark = pytest.mark.usefixtures("the_likeliest_is_expected")

# Estimates use 2^15 fixed draws here. Of independent draws a probability would have a standard
# error below .003; log-odds get five times the room, for their slope at the ends.
DRAWS = 1 << 15
TOLERANCE = 0.01
LOG_ODDS_TOLERANCE = 0.05


@pytest.fixture(autouse=True)
def _many_draws(monkeypatch):
    monkeypatch.setattr("training.fit.oracle.evidence.DRAWS", DRAWS)


@dataclass(frozen=True)
class Exact:
    """Conditional probabilities of a machine by summing its joint."""

    joint: Joint

    def place(self, triple) -> int | None:
        """Where a relation unit is; None where the machine has none."""
        e = self.joint.edges
        a, i, j = triple
        match = (e.relation[0] == a) & (e.subject[0] == i) & (e.object[0] == j)
        return int(match.nonzero()) if bool(match.any()) else None

    def unit(self, triple) -> torch.Tensor | None:
        """(N,) values of a relation unit; None where the machine has none."""
        place = self.place(triple)
        return None if place is None else self.joint.r[:, place] > 0

    def given(self, present, absent, observed=(), off=()):
        """(N,) bool: states with these classes on and off, and these triples on and off."""
        where = torch.ones(len(self.joint.v), dtype=torch.bool)
        for i in present:
            where &= self.joint.v[:, i] > 0
        for i in absent:
            where &= self.joint.v[:, i] == 0
        for triple in observed:
            unit = self.unit(triple)
            if unit is not None:
                where &= unit
        for triple in off:
            unit = self.unit(triple)
            if unit is not None:
                where &= ~unit
        return where

    def object(self, i, present, observed=()) -> float:
        """Log-odds of class i given that all others are as stated and some relations on."""
        rest = set(present) - {i}
        others = set(range(self.joint.machine.spec.V)) - rest - {i}
        touching = [t for t in observed if i in t[1:]]
        kept = [t for t in observed if t not in touching]
        return self.joint.log_odds(self.joint.v[:, i] > 0, self.given(rest, others, kept))

    def relation(self, triple, present, observed=(), off=(), *, implied=True) -> float:
        """p(r_e = 1) given the classes and the other observed relations, on and off.

        Where relations imply each other that is defined by their logits, not by the joint.
        """
        unit = self.unit(triple)
        if unit is None:
            return 0.0
        spec = self.joint.machine.spec
        absent = set(range(spec.V)) - set(present)
        kept = [t for t in observed if t != triple]
        if spec.G and implied:
            on = torch.zeros(spec.A, spec.V, spec.V)
            for t in kept:
                on[t] = 1.0
            where = self.given(present, absent, kept, off)
            return relation_by_definition(self.joint, self.place(triple), where, on)
        where = self.given(present, absent, kept, off)
        return 1 / (1 + math.exp(-self.joint.log_odds(unit, where)))


@pytest.fixture(scope="module", params=EXACT)
def case(request):
    artifact = exact_artifact(request.param)
    return artifact, Exact(enumerate_joint(machine_of(artifact.weights)))


# Classes of a scene and the canonical triples stated of them (classes are places here).
SCENES = [
    ([0], None),
    ([2], None),
    ([0, 1], None),
    ([0, 1], [(0, 0, 1)]),
    ([1, 2], [(0, 1, 0)]),
    ([0, 1, 2], [(0, 2, 0), (0, 0, 1)]),
]


# At the neutral coverage of 1/2; the other unlisted classes count as absent.
UNLISTED = math.log(0.5)


def triples(classes, stated):
    return [(a, classes[i], classes[j]) for a, i, j in stated or ()]


def is_exact(artifact, stated):
    return artifact.spec.form == "local" and not stated


@pytest.mark.parametrize(("classes", "stated"), SCENES[:5])
def test_missing(case, classes, stated):
    artifact, exact = case
    answers = missing(artifact, scene_of(classes, stated))
    absent = set(range(3)) - set(classes)
    assert {answer.label for answer in answers} == {LABELS[i] for i in absent}
    observed = triples(classes, stated)
    truth = {LABELS[i]: UNLISTED + exact.object(i, classes, observed) for i in absent}
    exactly = is_exact(artifact, stated)
    near = 1e-9 if exactly else TOLERANCE
    for answer in answers:
        around = 1e-9 if exactly else LOG_ODDS_TOLERANCE
        assert answer.log_odds == pytest.approx(truth[answer.label], abs=around)
        expected = 1 / (1 + math.exp(-truth[answer.label]))
        assert answer.probability == pytest.approx(expected, abs=near)


@pytest.mark.parametrize(("classes", "stated"), SCENES[:5])
def test_placements(case, classes, stated):
    """p(r_e = 1 | the candidate is there too), then made exclusive; the best three.

    What the observed relations imply for those of a candidate is left out.
    """
    artifact, exact = case
    A = artifact.spec.A
    observed = triples(classes, stated)
    for answer in missing(artifact, scene_of(classes, stated)):
        i = LABELS.index(answer.label)
        truth = {}
        for anchor, x in enumerate(classes):
            for a in range(A):
                p = exact.relation((a, i, x), [*classes, i], observed, implied=False)
                q = exact.relation((a, x, i), [*classes, i], observed, implied=False)
                truth[CANONICAL[a], anchor] = p / max(1, p + q)
                truth[OPPOSITES[CANONICAL[a]], anchor] = q / max(1, p + q)
        best = sorted(truth.values(), reverse=True)[:3]
        assert [place.probability for place in answer.placements] == pytest.approx(
            best, abs=TOLERANCE
        )
        for place in answer.placements:
            expected = truth[place.relation, place.object]
            assert place.probability == pytest.approx(expected, abs=TOLERANCE)


@pytest.mark.parametrize("relation", ["left", "right"])
@pytest.mark.parametrize("anchor", [0, 1, 2])
def test_missing_at_a_place(case, relation, anchor):
    artifact, exact = case
    scene = scene_of([anchor])
    answers = missing(artifact, scene, at=(relation, 0))
    scores = {}
    for i in set(range(3)) - {anchor}:
        triple = (0, i, anchor) if relation == "left" else (0, anchor, i)
        p = exact.relation(triple, [anchor, i])
        there = 1 / (1 + math.exp(-UNLISTED - exact.object(i, [anchor])))
        scores[LABELS[i]] = there * max(p, math.exp(-30))
    for answer in answers:
        assert answer.probability == pytest.approx(scores[answer.label], abs=TOLERANCE)


@pytest.mark.parametrize(("classes", "stated"), SCENES[2:])
def test_relations(case, classes, stated):
    """Each relation given the others, itself left out, made exclusive."""
    artifact, exact = case
    answers, _ = relations(artifact, scene_of(classes, stated), top_k=100)
    observed = triples(classes, stated)
    n = len(classes)
    assert len(answers) == n * (n - 1) * artifact.spec.A
    for answer in answers:
        a = CANONICAL.index(answer.relation)
        i, j = classes[answer.subject], classes[answer.object]
        p = exact.relation((a, i, j), classes, observed)
        q = exact.relation((a, j, i), classes, observed)
        assert answer.probability == pytest.approx(p / max(1, p + q), abs=TOLERANCE)


@pytest.mark.parametrize("complete", [False, True])
@pytest.mark.parametrize(
    ("classes", "stated"), [*SCENES[3:], ([2, 0, 1], [(0, 0, 1), (0, 1, 2), (0, 0, 2)])]
)
def test_disagreements(case, classes, stated, complete):
    """Each pair of which something is stated, judged by the joint without all that is known of it.

    Where two relations are as likely as an estimate can tell, either may be expected.
    """
    artifact, exact = case
    A = artifact.spec.A
    scene = scene_of(classes, stated, complete=complete)
    _, found = relations(artifact, scene, top_k=100)
    answers = {(answer.subject, answer.object): answer for answer in found}
    on = triples(classes, stated)
    units = [(a, i, j) for a in range(A) for i in classes for j in classes if i != j]
    off = [unit for unit in units if unit not in on] if complete else []
    for _, x, y in stated:
        i, j = classes[x], classes[y]
        rest, rest_off = ([t for t in some if {*t[1:]} != {i, j}] for some in (on, off))
        truth = {}
        for a in range(A):
            p, q = (
                exact.relation((a, *ends), classes, rest, rest_off) for ends in ((i, j), (j, i))
            )
            truth[CANONICAL[a]] = p / max(1, p + q)
            truth[OPPOSITES[CANONICAL[a]]] = q / max(1, p + q)
        observed = {CANONICAL[a] for a, *ends in stated if ends == [x, y]}
        likeliest, seen = max(truth.values()), max(truth[name] for name in observed)
        answer = answers.pop((x, y), None)
        if answer is None:
            assert likeliest < seen + 2 * TOLERANCE
            continue
        assert set(answer.observed) == observed
        assert answer.expected not in observed
        assert answer.probability == pytest.approx(truth[answer.expected], abs=TOLERANCE)
        assert answer.probability == pytest.approx(likeliest, abs=2 * TOLERANCE)
        assert answer.observed_probability == pytest.approx(seen, abs=TOLERANCE)
    assert not answers


def test_small_machines_disagree_with_some_scenes_and_not_with_others():
    """So that the test above sees both."""
    listed = {
        (name, k): bool(relations(exact_artifact(name), scene_of(*SCENES[k]))[1])
        for name in EXACT
        for k in (3, 4, 5)
    }
    assert len(set(listed.values())) == 2


@pytest.mark.parametrize(("classes", "stated"), SCENES)
def test_outliers(case, classes, stated):
    artifact, exact = case
    _, found, misplaced = outliers(artifact, scene_of(classes, stated))
    observed = triples(classes, stated)
    exactly = is_exact(artifact, stated)
    near = 1e-9 if exactly else TOLERANCE
    for answer in found:
        truth = exact.object(classes[answer.object], classes, observed)
        around = 1e-9 if exactly else LOG_ODDS_TOLERANCE
        assert answer.log_odds == pytest.approx(truth, abs=around)
        assert answer.probability == pytest.approx(1 / (1 + math.exp(truth)), abs=near)
    assert len(misplaced) == len(observed)
    for answer in misplaced:
        a = CANONICAL.index(answer.relation)
        triple = (a, classes[answer.subject], classes[answer.object])
        p = exact.relation(triple, classes, observed)
        assert answer.probability == pytest.approx(1 - p, abs=TOLERANCE)


@pytest.mark.parametrize("name", EXACT)
def test_reasons(name):
    """What each other object adds to the log-odds: exact where these are, else a mean field, which
    is near for weights of .6."""
    artifact = exact_artifact(name, scale=0.6)
    exact = Exact(enumerate_joint(machine_of(artifact.weights)))
    classes = [0, 1, 2]
    near = 1e-9 if is_exact(artifact, None) else 0.15
    scene = scene_of(classes)
    outlying = outliers(artifact, scene, threshold=0.0).outliers
    fitting = outliers(artifact, scene, threshold=1.0).outliers
    for answer in (*outlying, *fitting):
        i = classes[answer.object]
        truth = {
            j: exact.object(i, classes) - exact.object(i, [c for c in classes if c != j])
            for j in classes
            if j != i
        }
        sign = -1 if answer.is_outlier else 1
        # Near zero a mean field may have the other sign.
        assert {b.object for b in answer.because} >= {j for j in truth if sign * truth[j] > near}
        assert all(sign * because.log_odds_change > 0 for because in answer.because)
        for because in answer.because:
            assert because.log_odds_change == pytest.approx(truth[because.object], abs=near)
        sizes = [abs(because.log_odds_change) for because in answer.because]
        assert sizes == sorted(sizes, reverse=True)


@pytest.mark.parametrize("name", EXACT)
@pytest.mark.parametrize("classes", [[0], [2, 0], [1, 2], [1, 1, 2]])
def test_reasons_for_what_is_missing(name, classes):
    """As far as for outliers: what each class adds that is there, which left out is one fewer."""
    artifact = exact_artifact(name, scale=0.6)
    exact = Exact(enumerate_joint(machine_of(artifact.weights)))
    near = 1e-9 if is_exact(artifact, None) else 0.15
    for answer in missing(artifact, scene_of(classes)):
        i = LABELS.index(answer.label)
        truth = {
            classes.index(j): exact.object(i, classes)
            - exact.object(i, [c for c in classes if c != j])
            for j in set(classes)
        }
        assert {b.object for b in answer.because} == set(truth)
        for because in answer.because:
            assert because.log_odds_change == pytest.approx(truth[because.object], abs=near)


@pytest.mark.parametrize("name", [name for name in EXACT if EXACT[name].C])
def test_the_room_type_counts(name):
    artifact = exact_artifact(name)
    for room in range(2):
        exact = Exact(enumerate_joint(machine_of(artifact.weights), room))
        near = 1e-9 if is_exact(artifact, None) else LOG_ODDS_TOLERANCE
        for answer in missing(artifact, scene_of([0], room=room)):
            truth = UNLISTED + exact.object(LABELS.index(answer.label), [0])
            assert answer.log_odds == pytest.approx(truth, abs=near)
