"""Answers to the scoring questions, compared with the enumerated joint of a small machine."""

import copy
from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np
import pytest
import torch
from scipy.special import expit as sigmoid

from app.scene import CANONICAL, OPPOSITES
from tests.enumeration.small_machines import (
    Joint,
    enumerate_joint,
    mean_rates,
    relation_by_definition,
)
from tests.questions.answers import disagreements, missing, outliers, relations
from tests.questions.artifacts import (
    DOUBTING,
    EXACT,
    LABELS,
    artifact_of,
    random_machine,
    scene_of,
)

pytestmark = pytest.mark.usefixtures("without_minimums")

# The logit of a relation is not normal for few hidden units; see test_relation_units.
TOLERANCE = 0.02

# The classes of a scene, and its canonical relations (relation, subject, object).
SCENES = [
    ([0], None),
    ([2], None),
    ([0, 1], None),
    ([0, 1], [(0, 0, 1)]),
    ([1, 2], [(0, 1, 0)]),
    ([0, 1, 2], [(0, 2, 0), (0, 0, 1)]),
]
# Machines, room types and profiles.
CASES = [
    (name, room, profile)
    for name, spec in EXACT.items()
    for room, profile in product([None, *range(spec.C)][:3], [None, *range(spec.profiles)][:2])
]


@dataclass(frozen=True)
class Exact:
    """Conditional probabilities of a machine, as sums over its joint."""

    joint: Joint
    source: int  # of the joint, or -1 if the answers infer it

    def unit(self, triple):
        """The index of a relation unit, or None if the machine does not have it."""
        e = self.joint.edges
        a, i, j = triple
        match = (e.relation[0] == a) & (e.subject[0] == i) & (e.object[0] == j)
        return int(match.nonzero()) if bool(match.any()) else None

    def states(self, present, free=None):
        """(N,) bool: the states with exactly these classes, except the free class."""
        v = self.joint.v > 0
        where = torch.ones(len(v), dtype=torch.bool)
        for k in set(range(v.shape[1])) - {free}:
            where &= v[:, k] == (k in present)
        return where

    def object(self, i, present):
        """Log-odds of class i, given the other classes. Relations are unobserved."""
        log_odds = self.joint.log_odds(self.joint.v[:, i] > 0, self.states(present, free=i))
        # The answers leave out the base rates u of whole scenes.
        log_odds -= float(self.joint.machine.u[self.source, i])
        if self.source >= 0:
            return log_odds
        machine, others = self.joint.machine, set(present) - {i}
        return log_odds + float(
            mean_rates(machine, [j in others for j in range(machine.spec.V)])[i]
        )

    def kappa(self, i, coverage):
        """The bias of class i for the listed share of a scene."""
        middles = [0.15, 0.45, 0.8, 1.0]
        return float(np.interp(coverage, middles, self.joint.machine.kappa[:, i].tolist()))

    def relation(self, triple, present, observed=()):
        """p(r_e = 1), given the classes. Observed relations act by implications only."""
        if (unit := self.unit(triple)) is None:
            return 0.0
        spec, where = self.joint.machine.spec, self.states(present)
        if spec.G:
            on = torch.zeros(spec.A, spec.V, spec.V)
            for other in observed:
                on[other] = 1.0
            return relation_by_definition(self.joint, unit, where, on)
        return sigmoid(self.joint.log_odds(self.joint.r[:, unit] > 0, where))

    def between(self, i, j, *given):
        """The probability of each relation from class i to class j, made exclusive."""
        p = {}
        for a in range(self.joint.machine.spec.A):
            there, back = (self.relation((a, *ends), *given) for ends in ((i, j), (j, i)))
            p[CANONICAL[a]] = there / max(1, there + back)
            p[OPPOSITES[CANONICAL[a]]] = back / max(1, there + back)
        return p


@cache
def exact_case(name, scale=1.3, room=None, profile=None):
    """An artifact, and the joint of its machine under a room type and a profile."""
    machine = random_machine(EXACT[name], scale)
    source = -1 if profile is None else profile
    joint = enumerate_joint(copy.deepcopy(machine).double(), room, source=source)
    return artifact_of(machine), Exact(joint, source)


@pytest.fixture(params=EXACT)
def case(request):
    """For relations, whose errors grow with the weights."""
    return exact_case(request.param, scale=0.6)


def triples(classes, stated):
    return [(a, classes[i], classes[j]) for a, i, j in stated or ()]


def close(value):
    """Up to float32 weights and six significant digits."""
    return pytest.approx(value, rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("coverage", [None, 0.0, 0.3, 0.45, 0.7, 0.95, 1.0])
@pytest.mark.parametrize(("name", "room", "profile"), CASES)
def test_missing(name, room, profile, coverage):
    """Stated relations change no class. The default coverage of these artifacts is 1/2."""
    artifact, exact = exact_case(name, room=room, profile=profile)
    for classes, stated in SCENES[:5]:
        scene = scene_of(classes, stated, room, profile=profile)
        entries = missing(artifact, scene, coverage=coverage)
        labels = {LABELS[i] for i in {0, 1, 2}.difference(classes)}
        assert {entry.label for entry in entries} == labels
        for entry in entries:
            i = LABELS.index(entry.label)
            share = 0.5 if coverage is None else coverage
            log_odds = exact.object(i, classes) + exact.kappa(i, share)
            assert entry.log_odds == close(log_odds)
            assert entry.probability == close(sigmoid(log_odds))


@pytest.mark.parametrize(("name", "room", "profile"), CASES)
def test_outliers(name, room, profile):
    """All classes but one are listed, so the last row of kappa counts."""
    artifact, exact = exact_case(name, room=room, profile=profile)
    calibration = artifact.calibration.model_copy(update={"outlier": DOUBTING})
    artifact = replace(artifact, calibration=calibration)
    for classes, stated in SCENES:
        scene = scene_of(classes, stated, room, profile=profile)
        entries = outliers(artifact, scene).outliers
        assert {entry.object for entry in entries} == set(range(len(classes)))
        for entry in entries:
            i = classes[entry.object]
            log_odds = exact.object(i, classes) + exact.kappa(i, 1.0)
            assert entry.log_odds == close(-log_odds)
            assert entry.probability == close(sigmoid(-log_odds))


@pytest.mark.parametrize(("classes", "stated"), SCENES[:5])
def test_placements(case, classes, stated):
    """The best three, without what observed relations imply for relations of a candidate."""
    artifact, exact = case
    for entry in missing(artifact, scene_of(classes, stated)):
        i = LABELS.index(entry.label)
        expected = {
            (relation, anchor): p
            for anchor, x in enumerate(classes)
            for relation, p in exact.between(i, x, [*classes, i]).items()
        }
        best = sorted(expected.values(), reverse=True)[:3]
        probabilities = [place.probability for place in entry.placements]
        assert probabilities == pytest.approx(best, abs=TOLERANCE)
        for place in entry.placements:
            p = expected[place.relation, place.object]
            assert place.probability == pytest.approx(p, abs=TOLERANCE)


@pytest.mark.parametrize(("classes", "stated"), SCENES[2:])
def test_relations(case, classes, stated):
    """The probability of each relation, made exclusive. A stated relation holds."""
    artifact, exact = case
    entries = relations(artifact, scene_of(classes, stated), top_k=100)
    assert len(entries) == len(classes) * (len(classes) - 1) * artifact.spec.A
    for entry in entries:
        i, j = classes[entry.subject], classes[entry.object]
        p = exact.between(i, j, classes, triples(classes, stated))[entry.relation]
        a = CANONICAL.index(entry.relation)
        if (a, entry.subject, entry.object) in (stated or ()):
            assert entry.observed
            assert entry.probability == 1
            assert entry.expected == pytest.approx(p, abs=TOLERANCE)
            continue
        assert not entry.observed
        assert "expected" not in entry._fields
        if (a, entry.object, entry.subject) in (stated or ()):
            p = min(p, 0.01)
        assert entry.probability == pytest.approx(p, abs=TOLERANCE)


@pytest.mark.parametrize("complete", [False, True])
@pytest.mark.parametrize(
    ("classes", "stated"), [*SCENES[3:], ([2, 0, 1], [(0, 0, 1), (0, 1, 2), (0, 0, 2)])]
)
def test_disagreements(case, classes, stated, complete):
    """If two relations are about equally likely, either may be the expected relation."""
    artifact, exact = case
    scene = scene_of(classes, stated, complete=complete)
    entries = {(d.subject, d.object): d for d in disagreements(artifact, scene, top_k=100)}
    on = triples(classes, stated)
    for _, x, y in stated:
        i, j = classes[x], classes[y]
        rest = [unit for unit in on if {*unit[1:]} != {i, j}]
        expected = exact.between(i, j, classes, rest)
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


@pytest.mark.parametrize(("classes", "stated"), SCENES[3:])
def test_misplaced(case, classes, stated):
    """An observed relation is no evidence for itself."""
    artifact, exact = case
    observed = triples(classes, stated)
    entries = outliers(artifact, scene_of(classes, stated)).misplaced
    assert len(entries) == len(observed)
    for entry in entries:
        triple = (CANONICAL.index(entry.relation), classes[entry.subject], classes[entry.object])
        p = exact.relation(triple, classes, [other for other in observed if other != triple])
        assert entry.probability == pytest.approx(1 - p, abs=TOLERANCE)
