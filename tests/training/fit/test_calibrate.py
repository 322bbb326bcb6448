"""Calibration: what is chosen on validation, and what the fitted entries keep."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from training.fit.intruder_scores import (
    IntruderScores,
    alarm_threshold,
    clean_scores,
    intruder_scores,
)
from training.fit.machine_scores import MachineScore
from training.fit.object_weights import fit_objects, store_samples

from app.questions.posterior import Posterior, calibrated
from app.registry import Calibration, CountSlope
from tests.questions.answers import outliers
from tests.questions.artifacts import artifact_of
from tests.training.evaluation.furnished_rooms import STRUCTURE, VOCABULARY, rooms
from tests.training.evaluation.scenes import WIDE, larger_machine, random_scenes, scene, tensors
from training.datasets.cases import RIDGE, logistic
from training.evaluation.alarms import ALARMS, untouched_alarms
from training.evaluation.asking import of_classes
from training.evaluation.calibration_task import collect_missing
from training.evaluation.parts import up_to_longest
from training.fit.calibrate import calibrate, fit_misplaced, fit_relations, rising_curve
from training.fit.calibrate_objects import (
    ALPHAS,
    COVERAGES,
    EVIDENCE_WEIGHTS,
    LEAST,
    WEIGHTS,
    calibrate_objects,
    choose_alpha,
    complete_scenes,
    fit_coverage,
    fit_evidence,
    limit_of,
    listing,
    popularity,
    recalibrated,
    smallest_good_weight,
    smallest_scenes,
    thresholds,
)
from training.fit.configuration import ObjectsConfig
from training.machines import MachineSpec, build
from training.machines.arrays import machine_of
from training.runs.publish import draft_artifact

ROOM_COUNT = 400


def with_intruders(clean, beside, intruder, size):
    """Log-odds of one object a scene, untouched and beside an intruder, and of the intruder."""
    count = len(clean)
    return IntruderScores(
        scene=np.repeat(np.arange(count), 3),
        log_odds=np.stack([clean, beside, intruder], 1).ravel(),
        intruder=np.tile([False, False, True], count),
        size=np.full(3 * count, size),
        clean=np.tile([True, False, False], count),
        thing=np.tile([0, 0, 1], count),
        scenes=count,
        skipped=0,
    )


def scores_of(levels):
    """One object a scene, log-odds spread by `levels` per scene; and the same with an intruder."""
    rng = np.random.default_rng(0)
    clean = 3.0 + rng.normal(0.0, 1.0, len(levels)) * levels
    return with_intruders(clean, clean, rng.normal(-4.0, 1.0, len(levels)), 4)


def alarms(sizes, spread, share):
    """Share of untouched scenes over the threshold, per source."""
    source = np.repeat(["a", "b"][: len(sizes)], sizes)
    scenes = tensors(
        [scene([0, 1], source=name, group=f"g{k // 4}") for k, name in enumerate(source)], WIDE
    )
    scores = scores_of(np.repeat(spread, sizes))
    rng = np.random.default_rng(0)
    threshold = alarm_threshold(-scores.log_odds, scores, scenes, rng, share)
    over = -scores.log_odds >= threshold
    return [float(over[scores.clean][source == name].mean()) for name in np.unique(source)]


@pytest.mark.parametrize("share", ALARMS.values())
def test_alarms_are_kept_in_each_source_alike(share):
    """The second source's scenes are far more varied: one quantile over both would let it alarm in
    about twice the promised share."""
    quiet, varied = alarms([400, 400], [1.0, 3.0], share)
    assert share / 4 < varied <= share + 0.015
    assert quiet <= varied


@pytest.mark.parametrize("sizes", [[400, 30], [150, 100]])
def test_a_small_source_is_judged_with_the_rest(sizes):
    """A few scenes that are odd do not move the threshold to where nothing alarms."""
    shares = alarms(sizes, [1.0, 8.0], 0.1)
    assert shares[1] > 0


# ------------------------------------------------------------------------------ which scenes count


def test_scenes_count_by_weight_and_incomplete_ones_not_at_all():
    """Of 300 scenes of weight 1/3 about 100 are kept: outside 60 to 140 with p < 1e-6."""
    scenes = [scene([0, 1]) for _ in range(20)]
    scenes += [replace(scene([2, 3]), complete=False) for _ in range(20)]
    scenes += [replace(scene([4, 5]), weight=1 / 3) for _ in range(300)]
    kept = complete_scenes(tensors(scenes, WIDE))
    first = [int(one.evidence.classes[0]) for one in kept.scenes]
    assert first.count(0) == 20
    assert first.count(2) == 0
    assert 60 <= first.count(4) <= 140


def test_the_smallest_scenes_are_those_of_their_room_type():
    """Of a type of 20 scenes its own size, of fewer that of all; structure does not count."""
    large, small = scene([0, 1, 2, 3, 4], room=0), scene([1, 2, 3], room=1)
    data = tensors([large] * 20 + [small] * 19, WIDE)
    structure = torch.zeros(data.v.shape[1], dtype=torch.bool)
    assert smallest_scenes(data, structure, 3) == (5, 3, 3, 3)
    structure[0] = True
    assert smallest_scenes(data, structure, 2) == (4, 3, 3)
    assert smallest_scenes(tensors([large] * 20 + [small], WIDE), structure, 2) == (4, 4, 4)


def test_popularity_is_the_log_odds_of_a_class_in_a_complete_scene():
    scenes = [scene([0, 1]), scene([0]), replace(scene([0, 2]), weight=0.5)]
    found = popularity(tensors([*scenes, replace(scene([3]), complete=False)], WIDE))
    assert found[:4] == pytest.approx(np.log([3.0 / 0.5, 1.5 / 2.0, 1.0 / 2.5, 0.5 / 3.0]))


# --------------------------------------------------------------------------------------- intruders


def judged(hits):
    """Scores of intruders of which class 1 is popular: found in so many scenes of 10 at alpha 0.

    Where one is missed, it is .3 above the other object, alone and with it; a prior of 1 on class 1
    takes it below from alpha = .375 on.
    """
    own = np.where(np.arange(10) < hits, -1.0, 0.3)
    return with_intruders(np.zeros(10), np.zeros(10), own, 3)


PRIOR = np.array([0.0, 1.0])


def test_alpha_is_the_smallest_good_weight():
    kinds = {"uniform": judged(10), "popularity": judged(5), "signature": judged(5)}
    assert choose_alpha(kinds, PRIOR) == 0.375
    assert choose_alpha({"uniform": judged(10)}, PRIOR) == 0.0


def test_alpha_keeps_the_uniform_intruders():
    """Popular intruders would be found at .375; of uniform ones, which are rare classes, none."""
    rare = replace(judged(10), log_odds=np.tile([0.0, 0.0, -0.2], 10), thing=np.tile([1, 1, 0], 10))
    popular = judged(5)
    assert choose_alpha({"popularity": popular, "uniform": rare}, PRIOR) == 0.0
    assert choose_alpha({"popularity": popular}, PRIOR) == 0.375
    assert 0.375 in ALPHAS


@pytest.fixture(scope="module")
def model():
    """A machine of furnished rooms whose objects were trained, with stored samples."""
    data = rooms(ROOM_COUNT, 2)
    return draft_artifact(trained(data), VOCABULARY)


def trained(data):
    spec = MachineSpec(
        "triway", V=len(VOCABULARY), A=4, H1=90, K=3, C=len(VOCABULARY.room_types), N=256,
        form="local",
    )  # fmt: skip
    machine = build(spec).initialise(torch.Generator().manual_seed(0), 0.05)
    with torch.no_grad():
        share = data.v.mean(0).clamp(0.01, 0.99)
        machine.b.copy_((share / (1 - share)).log())
    fit_objects(machine, data, ObjectsConfig(epochs=30, chains=64, batch_size=32), seed=0)
    store_samples(machine, data, 0.5, seed=0)
    return machine.eval().requires_grad_(False)


@pytest.fixture(scope="module")
def fitted(model):
    return calibrate_objects(model, rooms(300, 1), rooms(ROOM_COUNT, 2), STRUCTURE)


def test_every_entry_of_objects_is_fitted(fitted):
    neutral = Calibration.neutral(4)
    for name in ("missing", "outlier", "outlier_thresholds", "popularity"):
        assert getattr(fitted, name) != getattr(neutral, name), name
    assert fitted.popularity_weight in ALPHAS
    assert fitted.coverage in COVERAGES
    assert fitted.coverage_weight in WEIGHTS
    assert fitted.evidence.relations_on_objects in EVIDENCE_WEIGHTS
    assert fitted.evidence.poses_on_objects in EVIDENCE_WEIGHTS
    # The likelier a class, the likelier it is missing; the likelier, the less an intruder.
    assert fitted.missing.slope > 0
    assert fitted.outlier.slope < 0
    assert fitted.relation == neutral.relation


def test_thresholds_keep_their_share_of_untouched_scenes(model, fitted):
    """On the scenes that they were fitted on."""
    scenes = complete_scenes(rooms(300, 1))
    scores = intruder_scores(scenes, STRUCTURE, MachineScore(machine_of(model.weights)))
    own = scores.with_prior(fitted.popularity_weight * np.array(fitted.popularity))
    p = 1 / (1 + np.exp(-calibrated(fitted.outlier, own.log_odds, own.size)))
    for name, share in ALARMS.items():
        found = own.false_alarms(p >= getattr(fitted.outlier_thresholds, name)).value
        assert 0 < found <= share + 0.01


def raised(calibration, scores):
    """Whether the service reports each object at medium sensitivity."""
    own = scores.with_prior(calibration.popularity_weight * np.array(calibration.popularity))
    p = 1 / (1 + np.exp(-calibrated(calibration.outlier, own.log_odds, own.size)))
    limits = [*calibration.short_list_thresholds, calibration.outlier_thresholds]
    medium = np.array([limit.medium for limit in limits])
    return p >= medium[np.minimum(scores.listed, len(limits)) - 1]


def test_lists_of_few_classes_keep_the_share_too(model, fitted):
    """On other parts of the rooms than were fitted on."""
    scenes, rng = complete_scenes(rooms(300, 1)), np.random.default_rng(7)
    artifact = replace(model, calibration=fitted)
    assert fitted.short_list_thresholds
    every = [*fitted.short_list_thresholds, fitted.outlier_thresholds]
    for name in ALARMS:
        limits = [getattr(one, name) for one in every]
        assert limits == sorted(limits, reverse=True)
    for listed in range(1, len(every)):
        some, parts = listing(scenes, STRUCTURE, listed, rng)
        plain = (parts > 0) & ~STRUCTURE
        assert (plain.sum(1) == listed).all()
        assert (parts <= some.v).all()
        assert (parts * STRUCTURE == some.v * STRUCTURE).all()
        assert ((some.v > 0) & ~STRUCTURE).sum(1).min() > listed
        found = clean_scores(parts, STRUCTURE, MachineScore(machine_of(model.weights)))
        assert (found.listed == listed).all()
        alarms = found.false_alarms(raised(fitted, found)).value
        # 300 rooms: a share of .1 lies above .17 with probability 1e-4.
        assert alarms <= 0.17
        k = int(found.scene[0])
        short = of_classes(parts[k].nonzero().squeeze(1).tolist())
        limit = outliers(artifact, short).threshold
        medium = fitted.short_list_thresholds[listed - 1].medium
        assert limit == pytest.approx(medium, rel=1e-5)
        assert limit >= fitted.outlier_thresholds.medium - 1e-6


def test_few_scenes_suffice_for_lists_of_few_classes(model):
    """Fitted on 24 rooms, as for a user with 300 scenes; measured on 300 other rooms."""
    few = calibrate_objects(model, rooms(24, 1), rooms(ROOM_COUNT, 2), STRUCTURE)
    scenes, rng = complete_scenes(rooms(300, 3)), np.random.default_rng(7)
    score = MachineScore(machine_of(model.weights))
    for listed in (1, 2, 3, 4):
        _, parts = listing(scenes, STRUCTURE, listed, rng)
        found = clean_scores(parts, STRUCTURE, score)
        alarms = found.false_alarms(raised(few, found)).value
        # The share of .1 is estimated from 24 rooms. It lies above .3 with probability 2e-3.
        assert alarms <= 0.3
        one_limit = few.model_copy(update={"short_list_thresholds": ()})
        whole = found.false_alarms(raised(one_limit, found)).value
        assert whole > 0.3 or listed > 2


def test_an_alarm_needs_a_probability_worth_an_alarm():
    """The target share of clean scenes would need alarms from .001."""
    scenes = complete_scenes(rooms(40, 1))
    certain = clean_scores(scenes.v, STRUCTURE, lambda v: torch.full(v.shape, 7.0))
    limits = thresholds(
        partial(limit_of, [(certain, scenes)], CountSlope(slope=-1.0), np.random.default_rng(0))
    )
    assert (limits.low, limits.medium, limits.high) == (0.5, 0.3, 0.2)


def test_hidden_classes_are_as_likely_as_said(model, fitted):
    """On 200 other rooms."""
    artifact = replace(model, calibration=fitted)
    found = collect_missing(artifact, rooms(200, 3), up_to_longest)
    assert found.score.mean() == pytest.approx(found.truth.mean(), abs=0.05)
    assert found.metric("ECE").value < 0.08
    assert found.metric("Brier skill").value > 0


@pytest.mark.slow
def test_a_seed_gives_the_same_calibration(model, fitted):
    again = calibrate_objects(model, rooms(300, 1), rooms(ROOM_COUNT, 2), STRUCTURE)
    assert again == fitted


def test_photographs_alone_are_calibrated_on_photographs():
    """There no scene lists all of its objects."""
    cut = tensors([replace(scene([0, 1]), complete=False) for _ in range(20)], WIDE)
    assert len(complete_scenes(cut)) == 20


def test_machines_without_samples_use_the_closed_form_alone():
    artifact = artifact_of(larger_machine("triway-local"))
    V = artifact.spec.V
    structure = torch.from_numpy(artifact.vocabulary.structure.copy())
    found = fit_coverage(artifact, tensors(random_scenes(40, V - 1), V), structure)
    assert found["coverage_weight"] == 0.0
    assert found["coverage"] == artifact.calibration.coverage


def test_the_least_pull_that_is_as_good_is_taken():
    """More evidence that brings nothing may do harm elsewhere."""
    assert smallest_good_weight({0.0: 0.400, 0.2: 0.402, 1.0: 0.4025}) == 0.0
    assert smallest_good_weight({0.0: 0.400, 0.2: 0.410, 1.0: 0.411}) == 0.2
    assert smallest_good_weight({0.0: 0.400, 0.2: 0.410, 1.0: 0.420}) == 1.0


def test_evidence_of_no_scene_has_no_weight():
    artifact = artifact_of(larger_machine("triway-local"))
    V = artifact.spec.V
    bare = tensors([scene([0, 1, 2]) for _ in range(5)], V)
    structure = torch.from_numpy(artifact.vocabulary.structure.copy())
    found = fit_evidence(artifact, bare, structure)
    assert (found.relations_on_objects, found.poses_on_objects) == (0, 0)


# --------------------------------------------------------------------------------------- relations


def test_relations_are_fitted_to_what_is_known():
    """Scenes of which nothing is known but what holds change no entry."""
    artifact = artifact_of(larger_machine("triway-local"))
    V = artifact.spec.V
    known = random_scenes(60, V - 1)
    vague = [
        replace(one, source="coco_captions", instance_observed=one.instance_holds)
        for one in random_scenes(60, V - 1, seed=1)
    ]
    fitted = fit_relations(artifact, known)
    assert all(entry.slope != 1.0 for entry in fitted)
    # Sources are numbered in the order of their names, and count by themselves.
    assert fit_relations(artifact, [*known, *vague]) == pytest.approx(fitted)
    assert fit_relations(artifact, vague) == Calibration.neutral(4).relation


def test_a_rising_curve_follows_a_bend_and_never_falls():
    """20,000 draws: the standard error of a log-odds is below .05 where they lie."""
    rng = np.random.default_rng(0)
    logits = rng.normal(0, 2, 20_000)
    places = np.linspace(-3, 3, 13)
    for law in (lambda z: np.where(z < 0, 0.3 * z, 2 * z) - 0.5, lambda z: -z):
        truth = rng.random(len(logits)) < 1 / (1 + np.exp(-law(logits)))
        intercept, slope, bends = rising_curve(logits, truth)
        line = intercept + slope * places
        found = line + sum(change * np.maximum(line - at, 0) for at, change in bends)
        assert (np.diff(found) > 0).all()
        if law(1.0) > law(0.0):
            assert found == pytest.approx(law(places), abs=0.3)


def test_a_ridge_bounds_the_slope_of_few_examples_and_leaves_many_alone():
    rng = np.random.default_rng(0)
    few = np.array([-6.0, -5.0, -4.0, 1.0, 2.0, 3.0])[:, None]
    assert logistic(few, few[:, 0] > 0)[0] > 3
    assert logistic(few, few[:, 0] > 0, C=RIDGE)[0] < 1.5
    many = rng.normal(0, 2, (5000, 1))
    truth = rng.random(5000) < 1 / (1 + np.exp(1 - many[:, 0]))
    assert logistic(many, truth, C=RIDGE) == pytest.approx(logistic(many, truth), rel=0.01)


def test_everything_is_calibrated_at_once(model):
    found = calibrate(model, rooms(120, 1), rooms(ROOM_COUNT, 2))
    neutral = Calibration.neutral(4)
    assert len(found.relation) == len(found.relation_given) == len(found.placement) == 4
    assert found.relation != neutral.relation
    limits = found.misplaced_thresholds
    assert 1 >= limits.low >= limits.medium >= limits.high >= LEAST["high"]
    assert found.misplaced.slope < 0  # unlikely relations are false


@pytest.mark.parametrize(("count", "sign"), [(120, 1), (15, 1), (60, -1)])
def test_misplaced_needs_enough_scenes_and_likely_true_relations(count, sign):
    """The true relations of a scene are those that the machine finds most (or least) likely."""
    artifact = artifact_of(larger_machine("triway-local"))
    scenes = []
    for k, one in enumerate(random_scenes(count, artifact.spec.V - 1)):
        classes = one.evidence.classes
        log_odds = sign * Posterior(artifact, of_classes(classes.tolist())).relation_log_odds()
        a, i, j = np.unravel_index(np.argsort(-log_odds, axis=None), log_odds.shape)
        triples = [(r, x, y) for r, x, y in zip(a, classes[i], classes[j], strict=True) if x < y]
        scenes.append(scene(classes.tolist(), triples[:3], group=f"group {k}"))
    found = fit_misplaced(artifact, scenes)
    if (count, sign) != (120, 1):
        assert found == {"misplaced": None, "misplaced_thresholds": None}
        return
    judging = recalibrated(artifact, **found)
    for name, share in ALARMS.items():
        (kept,) = (one for one in untouched_alarms(judging, scenes) if one.sensitivity == name)
        assert kept.scenes == count
        assert kept.alarms <= (share + 0.02) * count
