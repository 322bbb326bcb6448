"""Missing objects: the number of instances in `more`, and families of classes."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.model import Counts
from app.questions.missing import LIKELY, missing
from app.scene import ObjectClass, Scene, SceneObject, Vocabulary
from tests.questions.answers import more
from tests.questions.artifacts import LARGER, artifact_of, larger_artifact, random_machine, scene_of

SPEC = LARGER["triway"]
V, C, M = SPEC.V, SPEC.C, 5
LAMP, DESK, CHAIR, SHELF, WALL = 1, 2, 3, 6, 8
MOST = np.array([M - 1, M - 1, 2, M - 1])


def counts(scale: float = 0.6, seed: int = 0) -> Counts:
    """Random statistics of four classes. Wall is structure."""
    rng = np.random.default_rng(seed)
    classes = np.array([LAMP, CHAIR, SHELF, WALL])
    weights = rng.normal(0, scale, (4, 2, 3 + C + V))
    weights[np.arange(4), :, 3 + C + classes] = 0
    share = rng.dirichlet(np.ones(M), 4)
    return Counts(classes, MOST, np.log(share).astype("f4"), weights.astype("f4"))


COUNTS = counts(seed=7)
ARTIFACT = replace(larger_artifact("triway"), counts=COUNTS)
SCENE = scene_of([DESK, CHAIR, LAMP, CHAIR, WALL, WALL], room=1)
EVERY = list(range(V))


def by_hand(
    counts: Counts, row: int, listed: dict[int, int], room: int | None, rho: float = 1.0
) -> list[float]:
    """The formula of `app.model.Counts`, term by term."""
    own = int(counts.classes[row])
    k, others = listed[own], [j for j in listed if j != own]
    exponents = []
    for a, b, c, *rest in counts.weights[row].tolist():
        d, e = rest[:C], rest[C:]
        exponent = a + b * (k == 1) + (0.0 if room is None else d[room])
        if others:
            exponent += c * any(listed[j] > 1 for j in others)
            exponent += sum(e[j] for j in others) / math.sqrt(len(others))
        exponents.append(exponent)
    eta, zeta = exponents
    s = [math.exp(x) for x in counts.log_share[row].tolist()]
    weight = [0.0] * M
    for n in range(k, M + 1):
        middle = math.log(n) * math.log(M / n)
        weight[n - 1] = s[n - 1] * n**eta * math.exp(zeta * middle) * rho ** (n - k)
    return [w / sum(weight) for w in weight]


@given(
    st.dictionaries(st.sampled_from(range(WALL)), st.integers(1, M - 1), min_size=1),
    st.sampled_from([None, 0, 1]),
    st.sampled_from([1.0, 0.3, 0.0]),
    st.integers(0, 5),
)
def test_the_distribution_is_the_formula(listed, room, unlisted, seed):
    random = counts(seed=seed)
    classes = np.array(sorted(listed))
    numbers = np.array([listed[index] for index in classes.tolist()])
    which, p = random.distribution(V, classes, numbers, room, unlisted)
    largest = dict(zip(random.classes.tolist(), MOST.tolist(), strict=True))
    covered = [listed[index] <= largest.get(index, 0) for index in sorted(listed)]
    assert which.tolist() == np.flatnonzero(covered).tolist()
    for k, shares in zip(which.tolist(), p, strict=True):
        row = random.classes.tolist().index(classes[k])
        assert shares == pytest.approx(by_hand(random, row, listed, room, unlisted), abs=1e-6)


@pytest.mark.parametrize("coverage", [None, 0.2, 0.5, 0.9, 1.0])
def test_answers_are_the_moments_of_the_distribution(coverage):
    """Only a coverage above that of the model, 0.5, has an effect."""
    rho = {0.9: 0.2, 1.0: 0.0}.get(coverage, 1.0)
    entries = {e.label: e for e in more(ARTIFACT, SCENE, candidates=EVERY, coverage=coverage)}
    assert entries.keys() == {"lamp", "chair"}
    numbers = np.arange(1, M + 1)
    for row, label in ((0, "lamp"), (1, "chair")):
        p = np.array(by_hand(COUNTS, row, {DESK: 1, CHAIR: 2, LAMP: 1}, 1, rho))
        entry = entries[label]
        assert entry.listed_count == (2 if label == "chair" else 1)
        assert entry.expected_count == pytest.approx(p @ numbers, abs=1e-5)
        assert entry.probability == pytest.approx(p[entry.listed_count :].sum(), abs=1e-5)
        assert p[(numbers >= entry.low) & (numbers <= entry.high)].sum() >= 0.8
        assert p[numbers < entry.low].sum() < 0.1
        assert p[numbers > entry.high].sum() <= 0.1 + 1e-9


def test_only_probable_classes_are_listed_likeliest_first():
    every, entries = more(ARTIFACT, SCENE, candidates=EVERY), more(ARTIFACT, SCENE)
    likely = [entry for entry in every if entry.probability >= LIKELY]
    assert entries == tuple(sorted(likely, key=lambda entry: -entry.probability))
    assert 0 < len(entries) < len(every)
    assert more(ARTIFACT, SCENE, top_k=1) == entries[:1]
    assert more(ARTIFACT, SCENE, candidates=[DESK]) == ()
    assert more(ARTIFACT, SCENE, coverage=1.0) == ()


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("coverage", [None, 0.0, 1.0])
def test_the_largest_weights_of_a_store_give_finite_numbers(sign, coverage):
    huge = counts()
    weights = np.where(huge.weights == 0, 0, sign * 64).astype("f4")
    shares = np.full_like(huge.log_share, -64)
    shares[:, 0] = 0
    artifact = replace(
        larger_artifact("triway", coverage=1.0), counts=Counts(huge.classes, MOST, shares, weights)
    )
    scene = scene_of([index for index in range(WALL) for _ in range(M - 1)])
    entries = more(artifact, scene, candidates=EVERY, coverage=coverage)
    assert len(entries) == 2
    for entry in entries:
        assert math.isfinite(entry.expected_count)
        assert 0 <= entry.probability <= 1


# Families: a listed office chair is a chair, and a chair may be an office chair.
# shelf < desk < lamp and chair < lamp; vase < sofa.
PARENTS = {"desk": "lamp", "shelf": "desk", "chair": "lamp", "vase": "sofa"}
BASE = artifact_of(random_machine(LARGER["triway-states"], 1.0))
VOCABULARY = Vocabulary(
    [
        ObjectClass(entry.label, structure=entry.structure, parent=PARENTS.get(entry.label))
        for entry in BASE.vocabulary.objects
    ],
    BASE.vocabulary.room_types,
)
FAMILIES = replace(BASE, vocabulary=VOCABULARY)


def ask(*labels, artifact=FAMILIES, **options):
    """The labels and probabilities of /missing for a scene with these labels."""
    index = VOCABULARY.labels.index
    if names := options.pop("candidates", None):
        options["candidates"] = [index(name) for name in names]
    things = tuple(SceneObject(label, label, index(label)) for label in labels)
    answer = missing(artifact, Scene(things), details=False, **options)
    return {entry["label"]: entry["probability"] for entry in answer["missing"]}


@pytest.mark.parametrize(
    ("listed", "left_out"),
    [
        ("desk", {"desk", "lamp", "shelf"}),
        ("shelf", {"shelf", "desk", "lamp"}),
        ("lamp", {"lamp", "desk", "shelf", "chair"}),
        ("chair", {"chair", "lamp"}),
        ("bed", {"bed"}),
    ],
)
def test_no_class_of_a_listed_family_is_proposed(listed, left_out):
    every = ask(listed, artifact=BASE)
    proposed = ask(listed)
    assert not left_out & proposed.keys()
    # Of the others, the classes that have a likelier relative are left out.
    related = VOCABULARY.related
    index = VOCABULARY.labels.index
    for label, probability in every.items():
        if label in left_out:
            continue
        likelier = [
            x for x in proposed if every[x] > probability and related[index(x), index(label)]
        ]
        assert (label in proposed) != bool(likelier)
        assert probability == proposed.get(label, probability)


def test_the_list_is_full_although_relatives_are_left_out():
    assert list(ask("bed", top_k=2)) == list(ask("bed"))[:2]
    assert len(ask("bed", top_k=2)) == 2
    first, second = list(ask("bed"))[:2]
    assert not VOCABULARY.related[VOCABULARY.labels.index(first), VOCABULARY.labels.index(second)]


def test_named_kinds_of_a_listed_class_are_candidates_and_its_broader_classes_are_listed():
    proposed = ask("desk", candidates=["lamp", "shelf", "sofa", "vase"])
    assert proposed.keys() == {"shelf", "sofa", "vase"}
    assert not ask("shelf", candidates=["lamp", "desk"])
    assert ask("lamp", candidates=["desk", "shelf"]).keys() == {"desk", "shelf"}


@pytest.mark.parametrize("at", [None, ("on-top", 0)])
def test_places_follow_the_same_rule(at):
    answers = ask("desk", "bed", at=at)
    assert not {"lamp", "shelf", "desk", "bed"} & answers.keys()
    assert len({"sofa", "vase"} & answers.keys()) == 1
