from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from app.model import Calibration, CountSlope, CoverageFit
from app.model.calibration import KINDS
from app.questions.misplaced import POSED
from app.questions.posterior import calibrated
from app.scene import Vocabulary
from app.scene.spatial_relations import ABOVE, INSIDE, LATERAL, LEFT, ON_TOP, STACKED
from tests.questions.artifacts import artifact_of, random_machine
from tests.training.evaluation.furnished_rooms import STRUCTURE, VOCABULARY, A, rooms
from tests.training.evaluation.scenes import WIDE, random_scenes, scene, tensors
from tests.training.fit.test_objects import fit_objects
from training.datasets.batches import TrainingData
from training.datasets.roles import count_roles
from training.evaluation.calibration_task import ask_outliers, collect, collect_missing
from training.evaluation.outlier_tasks import ALARMS, draw_intruder_choices
from training.evaluation.parts import draw_parts, exactly, up_to_longest
from training.fit import calibrate_objects as of_objects
from training.fit.calibrate import (
    calibrate,
    fit_placements,
    fit_relations,
    fit_with_observed,
    with_lower_lateral,
)
from training.fit.configuration import ObjectsConfig
from training.fit.draft import draft_artifact, fit_places
from training.fit.objects import ObjectFit, ObjectScenes, served_popularity, start_objects
from training.machines import MachineSpec, build

ROOM_COUNT = 400
CONFIG = ObjectsConfig(steps=150, batch_size=64, learning_rate=0.03, generative_weight=0)


@pytest.fixture(scope="module")
def model():
    """A machine whose object weights are fitted to furnished rooms."""
    scenes = ObjectScenes.of(rooms(ROOM_COUNT, 2), STRUCTURE, CONFIG)
    V, C = len(VOCABULARY), len(VOCABULARY.room_types)
    sources = len(scenes.sources)
    spec = MachineSpec("triway", V=V, A=A, units=6, states=8, K=3, C=C, profiles=sources)
    machine = build(spec).initialise(torch.Generator().manual_seed(0), 0.05)
    start_objects(machine, scenes)
    fit_objects(ObjectFit(machine, scenes, CONFIG, seed=0))
    places = fit_places(rooms(ROOM_COUNT, 2).scenes, count_roles((), VOCABULARY), VOCABULARY)
    return draft_artifact(machine.eval().requires_grad_(False), VOCABULARY, places=places)


def data_of(validation) -> TrainingData:
    return TrainingData(rooms(ROOM_COUNT, 2), validation, validation, STRUCTURE, VOCABULARY)


@pytest.fixture(scope="module")
def fitted(model):
    return calibrate(model, data_of(rooms(200, 1)), CONFIG)


@pytest.fixture(scope="module")
def judging(model, fitted):
    return replace(model, calibration=fitted)


def test_every_entry_is_fitted(fitted):
    neutral = Calibration.neutral(A)
    # No room type is rare or written here, and no scene is of a home: see the tests of these fits.
    unfitted = {"popularity_weight", "rare_rooms", "written_rooms", "where"}
    entries = set(Calibration.model_fields) - unfitted
    assert {name for name in entries if getattr(fitted, name) == getattr(neutral, name)} == set()
    assert fitted.popularity_weight in of_objects.ALPHAS
    assert fitted.coverage in of_objects.COVERAGES
    # The likelier a class, the likelier it is missing, and the less likely it is an intruder.
    assert fitted.missing.slope > 0
    assert fitted.covered.slope > 0
    assert fitted.outlier.slope < 0
    # The better usual places explain a box, the less probably it is at a wrong place.
    assert all(getattr(fitted.misplaced, kind).stand < 0 for kind in KINDS[POSED:])
    assert fitted.misplaced.support.stand < 0
    # The machine has no relation weights, so the counts tell what stands where.
    assert all(entry.counts > 0 for entry in fitted.at)
    scenes = ObjectScenes.of(rooms(ROOM_COUNT, 2), STRUCTURE, CONFIG)
    assert fitted.popularity == pytest.approx(served_popularity(scenes, CONFIG).numpy(), abs=1e-4)


def test_chosen_values_are_copied(model, fitted):
    chosen = fitted.model_copy(update={"coverage": 0.15, "popularity_weight": 0.25})
    again = calibrate(model, data_of(rooms(60, 1)), CONFIG, chosen=chosen)
    assert (again.coverage, again.popularity_weight) == (0.15, 0.25)
    assert again.missing != fitted.missing


def test_scenes_count_by_weight_and_incomplete_ones_not_at_all():
    """Of 300 scenes of weight 1/3 about 100 are kept: outside 60 to 140 with p < 1e-6. If no scene
    lists all of its objects, as in photographs, all scenes count."""
    scenes = [scene([0, 1]) for _ in range(20)]
    cut = [replace(scene([2, 3]), complete=False) for _ in range(20)]
    scenes += [replace(scene([4, 5]), weight=1 / 3) for _ in range(300)]
    kept = of_objects.complete_scenes(tensors([*scenes, *cut], WIDE))
    first = [int(one.evidence.classes[0]) for one in kept.scenes]
    assert first.count(0) == 20
    assert first.count(2) == 0
    assert 60 <= first.count(4) <= 140
    assert len(of_objects.complete_scenes(tensors(cut, WIDE))) == 20


def test_the_named_sources_calibrate_answers():
    """At most 200 scenes of each source; without a named source of 20 scenes, all sources."""
    made = [scene([0, 1], source="procthor") for _ in range(500)]
    real = [scene([0, 1], source=name) for name in ["3dssg"] * 30 + ["sunrgbd"] * 450]
    few = [scene([0, 1], source="nr3d") for _ in range(19)]
    named = ["3dssg", "sunrgbd", "nr3d"]
    kept = of_objects.calibration_scenes(tensors([*made, *real, *few], WIDE), named)
    sources = [one.source for one in kept.scenes]
    assert {name: sources.count(name) for name in set(sources)} == {"3dssg": 30, "sunrgbd": 200}
    assert len(of_objects.calibration_scenes(tensors(made, WIDE), named)) == 200
    assert len(of_objects.calibration_scenes(tensors(made, WIDE), [])) == 200


def hidden_of(scenes, v):
    """The hidden classes of lists v, in scenes of which each has a list of each length."""
    lengths = [n for n in of_objects.LENGTHS if n < scenes.v[0].sum()]
    assert v.sum(1).tolist() == [n for n in lengths for _ in range(len(scenes))]
    return (scenes.v.repeat(len(lengths), 1) > v).numpy()


def test_the_coverage_that_ranks_best_is_chosen(monkeypatch):
    """The log-odds name the hidden classes the more often, the closer the coverage is to .45."""
    rng = np.random.default_rng(0)
    rows = [sorted(rng.permutation(WIDE)[:7].tolist()) for _ in range(200)]
    scenes = tensors([scene(row, name=f"scene {k}") for k, row in enumerate(rows)], WIDE)

    def log_odds(artifact, v, coverages):
        hidden = hidden_of(scenes, v)
        ranked = [hidden / (1 + 4 * abs(c - 0.45)) for c in coverages]
        return ranked + rng.normal(0, 0.5, (len(coverages), *hidden.shape))

    monkeypatch.setattr(of_objects, "unlisted_log_odds", log_odds)
    monkeypatch.setattr(of_objects, "_fit_covered", lambda *_: CoverageFit())
    model = SimpleNamespace(vocabulary=SimpleNamespace(structure=np.zeros(WIDE, np.bool_)))
    assert of_objects.fit_missing(model, scenes)["coverage"] == 0.45


@pytest.mark.parametrize(
    ("size", "error"),
    [(exactly(1), 0.1), (exactly(3), 0.1), (exactly(6), 0.1), (up_to_longest, 0.05)],
)
def test_hidden_classes_are_as_likely_as_the_answer_states(judging, size, error):
    """On 200 other rooms. The fit is a line in the log of the number of listed classes."""
    answers, _ = collect_missing(judging, rooms(200, 3), size)
    assert answers.score.mean() == pytest.approx(answers.truth.mean(), abs=error)
    assert answers.value < error + 0.03
    assert replace(answers, statistic="Brier skill").value > 0


def scores_of(log_odds, intruder, popularity=None, can_alarm=True):
    """Scores of lists, of which each row of log_odds, (lists, n), has the listed classes."""
    lists, n = log_odds.shape
    popularity = np.zeros(log_odds.shape) if popularity is None else popularity
    return of_objects.ListScores(
        row=np.repeat(np.arange(lists), n),
        log_odds=log_odds.ravel(),
        popularity=np.broadcast_to(popularity, log_odds.shape).ravel(),
        intruder=np.broadcast_to(intruder, log_odds.shape).ravel(),
        can_alarm=np.broadcast_to(can_alarm, log_odds.shape).ravel(),
        size=np.full(lists, n),
    )


CLEAN = scores_of(np.tile([0.1, 0.2, 0.3], (50, 1)), False)
LAST = np.array([False, False, True])


def intruders(log_odds, popularity):
    """50 lists of three classes, of which the last is an intruder."""
    return scores_of(np.tile([0.0, 0.0, log_odds], (50, 1)), LAST, [0.0, 0.0, popularity])


def test_alpha_weighs_all_kinds_of_intruders_alike():
    """A large alpha hides rare intruders, and a small one popular intruders."""
    rare, popular = intruders(-0.2, -1.0), intruders(0.1, 1.0)
    assert of_objects.choose_alpha([CLEAN], [rare, popular, popular]) == 0.125
    assert of_objects.choose_alpha([CLEAN], [rare, rare, popular]) in (0, 0.125)


@pytest.mark.parametrize("share", ALARMS.values())
def test_alarm_lines_keep_their_share_at_each_length(share):
    """4,000 lists of each length. The share of one length has a standard error of .002 to .006. The
    log-odds of each object are logistic. Given other objects they become more certain."""
    rng = np.random.default_rng(0)
    entry = CountSlope(intercept=-1.0, slope=-1.2, log_count=-0.4)

    def lists(n):
        return scores_of(rng.logistic(2 + 0.8 * np.log(n), 1.0, (4000, n)), False)

    worst = of_objects.worst_log_odds({n: lists(n) for n in of_objects.JUDGED_LENGTHS}, entry, 0.0)
    line = of_objects.fit_line(worst, share / of_objects.MARGIN)
    shares = []
    for n in of_objects.JUDGED_LENGTHS:
        scores = lists(n)
        z = calibrated(entry, scores.log_odds, scores.size[scores.row])
        alarm = 1 / (1 + np.exp(-z)) >= line.threshold(n)
        shares.append(np.bincount(scores.row, alarm).astype(bool).mean())
    assert np.mean(shares) == pytest.approx(share, abs=0.006)
    assert shares == pytest.approx([share] * len(shares), abs=0.02 + share / 10)


def test_alarm_lines_of_few_lengths_are_straight():
    """Three lengths give no parabola, and two no slope. A more sensitive line is never higher."""
    worst = {n: np.arange(100.0) - 10 * n for n in (2, 3, 5, 8, 12)}
    lengths = [*worst]
    for number, curved in ((5, True), (4, False), (3, False), (2, False), (1, False)):
        some = {n: worst[n] for n in lengths[:number]}
        low, medium, high = (of_objects.fit_line(some, share) for share in ALARMS.values())
        assert (medium.curve != 0, medium.log_count != 0) == (curved, number > 2)
        assert low.intercept > medium.intercept > high.intercept
        assert {(one.curve, one.log_count) for one in (low, high)} == {
            (medium.curve, medium.log_count)
        }


def test_a_class_that_raises_no_alarm_does_not_raise_the_line():
    """The last class of each list is the most suspicious, but the service never flags it."""
    entry = CountSlope(slope=-1.0)
    log_odds = np.tile([0.1, 0.2, -5.0], (50, 1))
    silent = of_objects.worst_log_odds({3: scores_of(log_odds, False, can_alarm=~LAST)}, entry, 0.0)
    assert of_objects.fit_line(silent, 0.1).intercept == pytest.approx(-0.1)
    every = of_objects.worst_log_odds({3: scores_of(log_odds, False)}, entry, 0.0)
    assert of_objects.fit_line(every, 0.1).intercept == 5.0


def test_intruders_are_as_likely_as_the_answer_states(judging):
    """Half of the parts of 200 other rooms have an intruder, of one of three kinds."""
    data = rooms(200, 3)
    choices = draw_intruder_choices(data, STRUCTURE, rooms(ROOM_COUNT, 2))
    answers, _ = collect(judging, data, partial(ask_outliers, intruders=choices))
    assert answers.score.mean() == pytest.approx(answers.truth.mean(), abs=0.04)
    assert answers.value < 0.06
    assert replace(answers, statistic="Brier skill").value > 0.1


def test_structure_and_classes_that_belong_anywhere_are_never_judged(judging):
    """Neither in untouched lists nor as intruders."""
    entries = [replace(c, anywhere=c.label in {"lamp", "book"}) for c in VOCABULARY.objects]
    vocabulary = Vocabulary(entries, VOCABULARY.room_types)
    artifact = replace(judging, vocabulary=vocabulary)
    judged = vocabulary.judged
    assert judged.sum() == len(judged) - int(STRUCTURE.sum()) - 2
    parts = draw_parts(rooms(100, 3), STRUCTURE, exactly(4))
    scores = of_objects.score_lists(artifact, parts)
    row, classes = np.nonzero(parts.v.numpy() * judged)
    assert scores.row.tolist() == row.tolist()
    assert scores.popularity.tolist() == np.array(artifact.calibration.popularity)[classes].tolist()
    assert scores.size.tolist() == [4] * len(parts.v)
    altered = of_objects.score_intruders(artifact, rooms(100, 3), torch.from_numpy(~judged + 1e-9))
    popularity = altered.popularity[altered.intruder]
    assert np.isin(popularity, np.array(artifact.calibration.popularity)[judged]).all()
    assert np.bincount(altered.row, altered.intruder).tolist() == [1.0] * len(altered.size)


@pytest.mark.parametrize("count", [19, 20])
def test_few_scenes_give_no_judgement_of_objects(judging, count):
    some = tensors(of_objects.calibration_scenes(rooms(60, 1), []).scenes[:count], len(VOCABULARY))
    entries = of_objects.fit_outliers(judging, some, rooms(ROOM_COUNT, 2))
    judged = {"popularity_weight", "outlier", "outlier_lines", "room_lines"}
    assert set(entries) == (judged if count == 20 else set())


@pytest.fixture(scope="module")
def random_artifact():
    return artifact_of(random_machine(MachineSpec("triway", V=9, A=A, units=6, K=3, C=2), 0.7))


FITS = pytest.mark.parametrize("fit", [fit_relations, fit_with_observed, fit_placements])


def without(one, relations):
    """The scene without the true relations of these kinds."""
    holds = one.instance_holds.copy()
    holds[list(relations)] = False
    return replace(one, instance_holds=holds)


@FITS
def test_stacked_relations_take_the_fit_of_on_top(random_artifact, fit):
    """Complete sources show few pairs with inside and none with above."""
    entries = fit(random_artifact, random_scenes(60, 8))
    assert {entries[a] for a in STACKED} == {entries[ON_TOP]}
    assert {entries[a] for a in LATERAL} == {entries[LEFT]}
    assert len({entries[ON_TOP], entries[LEFT], CountSlope()}) == 3


def test_only_on_top_determines_the_fit_of_stacked_relations(random_artifact):
    scenes = random_scenes(60, 8)
    entries = fit_relations(random_artifact, scenes)
    fewer = fit_relations(random_artifact, [without(one, (ABOVE, INSIDE)) for one in scenes])
    assert fewer == entries
    flat = fit_relations(random_artifact, [without(one, (ON_TOP,)) for one in scenes])
    assert {flat[a] for a in STACKED} == {CountSlope()}
    assert flat[LEFT] == entries[LEFT]


@FITS
def test_sources_without_false_relations_take_no_part(random_artifact, fit):
    """People mention sides of some pairs, and do not mention those of others. Sources are numbered
    in the order of their names, and count by themselves."""
    known = random_scenes(60, 8)
    vague = [
        replace(without(one, STACKED), source="coco_captions", instance_observed=one.instance_holds)
        for one in random_scenes(60, 8, seed=1)
    ]
    assert fit(random_artifact, vague) == Calibration.neutral(A).relation
    if fit is fit_relations:
        assert fit(random_artifact, [*known, *vague]) == pytest.approx(fit(random_artifact, known))


def test_sides_are_lowered_until_the_listed_relation_of_stacked_objects_is_likeliest():
    """On-top has the log-odds .05. Other values of the sides: test_pair_task."""
    machine = build(MachineSpec("triway", V=9, A=A, units=1, K=1, T=1))
    machine.set_triples(torch.tensor([[ON_TOP, 1, 0]]))
    with torch.no_grad():
        machine.residual.fill_(0.05)
    artifact = artifact_of(machine.eval().requires_grad_(False))
    sides = CountSlope(intercept=0.2)
    slopes = tuple(sides if a in LATERAL else CountSlope() for a in range(A))
    stacked = scene([0, 1, 2], [(ON_TOP, 1, 0), (LEFT, 2, 0)])
    lowered = with_lower_lateral(artifact, slopes, tensors([stacked] * 3, 9))
    for a in range(A):
        assert lowered[a].intercept == pytest.approx(0.2 - 0.4 if a in LATERAL else 0.0)
    beside = scene([0, 1], [(LEFT, 1, 0)])
    assert with_lower_lateral(artifact, slopes, tensors([beside], 9)) == slopes
