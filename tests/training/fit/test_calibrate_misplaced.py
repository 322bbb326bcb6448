from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch

from app.model import Misplaced
from app.model.calibration import KINDS, WEIGHTS
from app.questions import misplaced
from app.questions.misplaced import BESIDE, HELD, POSED, SUPPORT, TERMS, UNHELD, Entries
from app.scene.scene import observe
from app.scene.spatial_relations import INSIDE, ON_TOP
from tests.questions.artifacts import artifact_of
from tests.training.evaluation.furnished_rooms import STRUCTURE as WALLS
from tests.training.evaluation.furnished_rooms import VOCABULARY, A, rooms
from tests.training.evaluation.scenes import scene
from training.datasets.cases import draw_true_relations, scene_of, scene_rng
from training.datasets.inventories import shipped_things
from training.datasets.moved import lifted_or_sunk, moved_by_triple, moved_scene, posed_scene
from training.datasets.roles import count_roles
from training.evaluation.asking import score_misplaced
from training.evaluation.outlier_tasks import ALARMS
from training.fit import calibrate_misplaced as module
from training.fit.calibrate_misplaced import fit_misplaced, hardest_quantile
from training.fit.draft import draft_artifact, fit_places
from training.fit.possibility import fit_possibility
from training.machines import MachineSpec, build

V, SUPPORTERS = 9, 4
STRUCTURE = np.arange(V) == V - 1
# Log-odds that a class i is on a class j. Classes 4 to 7 stand on classes 0 to 3.
LOG_ODDS = np.full((V, V), -5.0)
LOG_ODDS[SUPPORTERS : V - 1, :SUPPORTERS] = np.random.default_rng(1).normal(-1, 2.5, (4, 4))


@pytest.fixture(scope="module")
def artifact():
    """A machine that knows the log-odds of supports, and nothing else."""
    spec = MachineSpec("triway", V=V, A=A, units=1, K=1, T=V * V)
    pairs = torch.cartesian_prod(torch.arange(V), torch.arange(V))
    machine = build(spec).set_triples(torch.column_stack([torch.full((V * V,), ON_TOP), pairs]))
    with torch.no_grad():
        machine.residual.copy_(torch.from_numpy(LOG_ODDS.ravel()))
    return artifact_of(machine.eval().requires_grad_(False))


def world(count: int, seed: int):
    """Scenes in which each of three things is on a supporter, drawn by the log-odds."""
    rng = np.random.default_rng(seed)
    scenes = []
    for k in range(count):
        things = rng.permutation(np.arange(SUPPORTERS, V - 1))[:3].tolist()
        triples = []
        for i in things:
            odds = np.exp(LOG_ODDS[i, :SUPPORTERS])
            triples.append((ON_TOP, i, int(rng.choice(SUPPORTERS, p=odds / odds.sum()))))
        classes = [*range(SUPPORTERS), *sorted(things)]
        scenes.append(scene(classes, triples, name=f"world {seed} {k}"))
    return scenes


@pytest.fixture(scope="module")
def fitted(artifact):
    return fit_misplaced(artifact, world(200, 0))


def judging(artifact, judgement):
    return replace(
        artifact, calibration=artifact.calibration.model_copy(update={"misplaced": judgement})
    )


def test_wrong_supports_get_a_higher_probability(artifact, fitted):
    """200 other scenes; a random answer ranks .5 of the pairs right, with a standard error of .03.
    One of three supports is wrong. The machine knows only the log-odds of supports."""
    assert fitted.support.relation < 0
    assert fitted.support.change == fitted.support.stand == 0
    model, right, wrong = judging(artifact, fitted), [], []
    for one in world(200, 1):
        moved = moved_by_triple(one, STRUCTURE, scene_rng(one, 0))
        if moved is None:
            continue
        request, index = moved
        entries = misplaced(model, request)
        assert {entry["moved"] for entry in entries} == {entry["subject"] for entry in entries}
        for entry in entries:
            (wrong if entry["moved"] == str(index) else right).append(entry["probability"])
    assert len(wrong) > 150
    assert np.mean(np.array(wrong)[:, None] > np.array(right)) > 0.75


def test_kinds_without_true_and_wrong_entries_are_not_judged(fitted):
    """The world has no side, no object above another one, and no stated under."""
    assert fitted == Misplaced(support=fitted.support)


def test_untouched_scenes_keep_the_share_of_alarms(artifact, fitted):
    """400 other scenes. With these standard errors, a larger share has a probability below .002."""
    model = judging(artifact, fitted)
    for name, promise in ALARMS.items():
        share = module._BUDGET["support"] * promise
        alarms = 0
        for one in world(400, 2):
            triples = draw_true_relations(one, STRUCTURE, scene_rng(one, 0))
            request = scene_of(one, range(len(one.instance_classes)), triples)
            entries = misplaced(model, request, sensitivity=name)
            alarms += any(entry["is_misplaced"] for entry in entries)
        assert alarms / 400 <= share + 3 * np.sqrt(share * (1 - share) * (1 / 400 + 1 / 200))


@pytest.mark.parametrize(("count", "is_judged"), [(19, False), (20, True)])
def test_few_scenes_give_no_judgement(artifact, count, is_judged):
    judgement = fit_misplaced(artifact, world(count, 3))
    assert (judgement.support is not None) == is_judged
    assert judgement.judges_relations == is_judged


def test_no_scenes_give_no_judgement(artifact):
    assert fit_misplaced(artifact, []) == Misplaced()
    alone = [scene([0, 1, 2], name=f"alone {k}") for k in range(30)]
    assert fit_misplaced(artifact, alone) == Misplaced()


def test_a_machine_that_finds_true_supports_unlikely_does_not_judge(artifact):
    """A likelier relation never makes an entry more suspicious."""
    weights = {name: array.copy() for name, array in artifact.weights.arrays.items()}
    weights["residual"] = -weights["residual"]
    inverted = replace(artifact, weights=replace(artifact.weights, arrays=weights))
    assert fit_misplaced(inverted, world(60, 0)).support is None


@pytest.mark.parametrize("share", ALARMS.values())
def test_the_share_is_kept_in_each_large_source(share):
    """The second source is far more varied: one quantile over both would raise more alarms."""
    rng = np.random.default_rng(0)
    values = np.concatenate([rng.normal(0, 1, 4000), rng.normal(0, 3, 4000)])
    sources = np.repeat(["a", "b"], 4000)
    limit = hardest_quantile(values, sources, 1 - share)
    alarms = [(values[sources == name] >= limit).mean() for name in ("a", "b")]
    assert alarms[1] == pytest.approx(share, abs=1e-3)
    assert alarms[0] < share / 2


def test_small_sources_count_as_one_and_equal_values_raise_no_alarm():
    """59 and 50 scenes; each alone would have another quantile."""
    values = np.concatenate([np.zeros(100), np.arange(59.0), np.full(50, 500.0)])
    limit = hardest_quantile(values, np.repeat(["large", "a", "b"], [100, 59, 50]), 0.5)
    assert limit == pytest.approx(np.median(values[100:]))
    assert not (np.full(3, np.median(values[100:])) >= limit).any()


def entries_of(*rows):
    """Entries (kind, triple, mover)."""
    kinds, triples, movers = zip(*rows, strict=True)
    terms = np.zeros((len(rows), TERMS))
    return Entries(np.array(triples), np.array(kinds), terms, np.array(movers, dtype=np.int64))


def test_a_moved_object_makes_its_support_wrong_and_its_other_relations_uncertain():
    entries = entries_of(
        (SUPPORT, (ON_TOP, 2, 0), 2),
        (BESIDE, (0, 2, 1), 2),
        (SUPPORT, (ON_TOP, 3, 2), 3),
        (POSED, (ON_TOP, 2, -1), 2),
        (HELD, (ON_TOP, 1, 0), 1),
        (UNHELD, (INSIDE, 4, 2), 4),
    )
    wrong, usable = module._truth(entries, 2)
    assert wrong.tolist() == [True, False, False, True, False, False]
    # What is on or in the moved object may be right or wrong.
    assert usable.tolist() == [True, False, False, True, True, False]
    wrong, usable = module._truth(entries, (ON_TOP, 3, 2))
    assert wrong.tolist() == [False, False, True, False, False, False]
    assert usable.all()
    wrong, usable = module._truth(entries, None)
    assert not wrong.any()
    assert usable.all()


# ------------------------------------------------------------------------------------------ boxes

KINDS_OF_BOXES = KINDS[POSED:]
KIND_OF = {
    "on-floor": "on_floor",
    "wrong-support": "on_object",
    **dict.fromkeys(("floats", "sunk-in"), "unheld"),
}


@pytest.fixture(scope="module")
def furnished():
    """A machine without any knowledge, and the places of furnished rooms."""
    spec = MachineSpec("triway", V=len(VOCABULARY), A=A, units=1, K=1)
    machine = build(spec).eval().requires_grad_(False)
    scenes = rooms(400, 2).scenes
    prior = fit_possibility([], scenes, VOCABULARY, shipped_things())
    places = fit_places(scenes, count_roles((), VOCABULARY), VOCABULARY, prior)
    model = draft_artifact(machine, VOCABULARY, places, prior)
    return judging(model, fit_misplaced(model, rooms(200, 1).scenes))


def test_boxes_at_wrong_places_are_judged_by_their_places(furnished):
    """Moved objects, and objects that float or are sunk in, in 60 other rooms."""
    fitted = furnished.calibration.misplaced
    for kind in KINDS_OF_BOXES:
        judgement = getattr(fitted, kind)
        assert judgement.stand < 0
        assert all(getattr(judgement, name) <= 0 for name in WEIGHTS)
        assert judgement.entries >= -1
        # No line depends on the number of entries.
        assert all(getattr(judgement.lines, name).log_count == 0 for name in ALARMS)
    structure, first = WALLS.numpy(), Counter()
    for make in (moved_scene, lifted_or_sunk):
        for one in rooms(60, 3).scenes:
            case = make(one, structure, scene_rng(one, 0))
            if case is not None:
                named = score_misplaced(furnished, case[0])
                right = bool(named) and named[0]["moved"] == str(case[1])
                first[make.__name__, right] += 1
    for make in (moved_scene, lifted_or_sunk):
        right, wrong = first[make.__name__, True], first[make.__name__, False]
        assert right + wrong >= 40
        assert right / (right + wrong) > 0.6


def test_untouched_boxes_keep_the_share_of_alarms_of_each_kind(furnished):
    """200 other rooms, with the standard errors of both."""
    asked = [posed_scene(one) for one in rooms(200, 4).scenes]
    for name, promise in ALARMS.items():
        alarms = Counter()
        for request in asked:
            entries = misplaced(furnished, seen(furnished, request), sensitivity=name)
            alarms.update({KIND_OF[entry["reason"]] for entry in entries if entry["is_misplaced"]})
        for kind in KINDS_OF_BOXES:
            share = module._BUDGET[kind] * promise
            assert alarms[kind] / 200 <= share + 3 * np.sqrt(share * (1 - share) / 100)


def seen(model, request):
    words = model.vocabulary
    return observe(request, typical_sizes=words.sizes, spread=model.spread, roles=model.roles)


@pytest.mark.parametrize("moved", range(4))
def test_a_part_of_boxes_has_the_objects_near_the_moved_one(moved):
    whole = replace(scene_of(scene([0, 1, 2, 3]), range(4), ()), relations=None)
    x = (0.0, 1.0, 3.0, 7.0)
    placed = (
        replace(thing, position=(at, 0, 0)) for thing, at in zip(whole.objects, x, strict=True)
    )
    whole, sizes = replace(whole, objects=tuple(placed)), Counter()
    nearest = sorted(range(4), key=lambda k: abs(x[k] - x[moved]))
    for seed in range(200):
        part, index = module._part_near(whole, moved, np.random.default_rng(seed))
        assert part.objects[index] == whole.objects[moved]
        kept = [int(thing.id) for thing in part.objects]
        assert kept == sorted(nearest[: len(kept)]), "the order stays"
        sizes[len(kept)] += 1
    # The logarithm of the number is uniform: log 1.5 / log 4 = .29 of the parts have one object.
    assert abs(sizes[1] / 200 - np.log(1.5) / np.log(4)) < 3 * np.sqrt(0.29 * 0.71 / 200)
    assert 0 < sizes[4] < sizes[3]


def test_scenes_with_boxes_are_asked_in_parts_too(furnished):
    """The moved or unheld object is in each part, and no scene has two wrong objects."""
    kinds = Counter()
    for one in rooms(30, 5).scenes:
        whole = posed_scene(one)
        asked = [case for case in module._questions(furnished, one, 0) if case[0].has_boxes]
        before = {thing.id: thing.position for thing in whole.objects}
        for request, wrong in asked:
            moved = {thing.id for thing in request.objects if thing.position != before[thing.id]}
            assert (wrong is None) == (not moved)
            if wrong is not None:
                assert request.objects[wrong].id in moved
            kinds[wrong is None, len(request.objects) == len(whole.objects)] += 1
    assert min(kinds.values()) >= 20
    assert len(kinds) == 4
