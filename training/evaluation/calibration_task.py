"""Calibration: compare the probabilities of the service with the truth.

An answer has a probability and a truth value. The answer to each question is true if:

    relations    the relation holds between the two objects. In one variant, the relations of half
                 of the pairs are evidence. In another variant, one object was removed. Relations
                 with unknown truth are left out (see `training.datasets.cases.annotated_relations`)
    missing      the class is in the scene and was hidden. A request lists 2, 4 or 8 random classes
                 of the scene. Classes that the data source cannot show are left out
    at a place   the class is in the scene at the place of the request, which lists up to 12 random
                 classes. A place is a relation to an object. The place is drawn from the places
                 that hold an object
    outliers     the object is an intruder, added to a random part of up to 12 classes. Half of the
                 parts contain one intruder
    misplaced    the listed relation is false. Half of the scenes contain one altered relation

The questions about hidden classes and intruders use scenes with complete object lists, and list no
structure. Requests contain no room type and use default parameters. Candidates that the service
does not return are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Int
from numpy.typing import NDArray

from app.model import (
    AlarmLine,
    AlarmLines,
    Calibration,
    CountSlope,
    Judgement,
    Misplaced,
    SceneModel,
)
from app.questions import misplaced, missing, outliers, relations
from app.questions.placements import Place
from app.scene import CANONICAL, Scene, Vocabulary, canonicalise
from training.datasets import EncodedScene
from training.datasets.array_types import Rng
from training.datasets.batches import SceneTensors
from training.datasets.cases import (
    altered_case,
    annotated_relations,
    observed_pairs,
    occupied_place,
    removed_class,
    scene_of,
    scene_rng,
)
from training.evaluation.asking import (
    canonical_triple,
    index_of_ids,
    labels_alone,
    thing_instances,
    with_intruder,
)
from training.evaluation.metrics import Metric, Scored
from training.evaluation.outlier_tasks import draw_intruder_choices
from training.evaluation.parts import (
    Size,
    all_but_one,
    draw_parts,
    exactly,
    of_classes,
    share_of,
    up_to_longest,
)
from training.evaluation.setting import Outcome, Setting

# Number of removed objects per scene in `ask_placements`. A removed object gives only 3 answers.
# With one per scene, chance alone gives a calibration error (ECE) of .02 to .03.
_REMOVALS = 4
_NO_ALARM = AlarmLine(intercept=1e3)
Answers = list[tuple[float, bool]]  # probability and truth value of each answer about one scene
Ask = Callable[[SceneModel, EncodedScene, Rng], Answers | None]


def scored(answers: list[tuple[int, float, bool]], scenes: int) -> Scored | None:
    """Return the ECE of answers with the index of their scene; None without answers."""
    if not answers:
        return None
    index, probability, truth = np.array(answers, dtype=np.float64).T
    return Scored("ECE", index.astype(np.int64), probability, truth > 0, np.arange(scenes))


def uncalibrated(artifact: SceneModel) -> SceneModel:
    """Return the artifact with raw log-odds in place of calibrated log-odds.

    The slope -1 turns the log-odds of an object or relation into those that it is wrong.
    """
    lines = AlarmLines(low=_NO_ALARM, medium=_NO_ALARM, high=_NO_ALARM)
    plain = Judgement(
        intercept=0.0,
        relation=-1.0,
        change=-1.0,
        stand=0.0,
        supporter=0.0,
        unknown=-1.0,
        entries=0.0,
        lines=lines,
    )
    neutral = Calibration.neutral(artifact.spec.A).model_copy(
        update={
            "outlier": CountSlope(slope=-1.0),
            "outlier_lines": lines,
            "misplaced": Misplaced(lateral=plain, support=plain, above=plain, under=plain),
        }
    )
    return replace(artifact, calibration=neutral)


def collect(
    artifact: SceneModel, scenes: SceneTensors, ask: Ask, seed: int = 0
) -> tuple[Scored | None, int]:
    """Ask one of `QUESTIONS` about every scene. Return the answers, and the skipped scenes."""
    answers = [ask(artifact, scene, scene_rng(scene, seed)) for scene in scenes.scenes]
    items = [(k, *answer) for k, of_scene in enumerate(answers) for answer in of_scene or ()]
    return scored(items, len(scenes)), answers.count(None)


def ask_relations(artifact: SceneModel, encoded: EncodedScene, rng: Rng) -> Answers | None:  # noqa: ARG001
    """Ask for all relations of a scene. The request contains only the labels of the objects."""
    mask = annotated_relations(encoded)
    return _answers_on(artifact, encoded, labels_alone(encoded), mask) or None


def ask_given(artifact: SceneModel, encoded: EncodedScene, rng: Rng) -> Answers | None:
    """Ask for the relations of half of the pairs. The relations of the other half are evidence."""
    is_queried, evidence = observed_pairs(encoded, artifact.vocabulary.structure, rng)
    if not evidence:
        return None
    scene = replace(scene_of(encoded, range(len(is_queried)), evidence), room_type=None)
    mask = annotated_relations(encoded) & is_queried
    return _answers_on(artifact, encoded, scene, mask) or None


def _answers_on(
    artifact: SceneModel,
    encoded: EncodedScene,
    scene: Scene,
    mask: Bool[NDArray, "A objects objects"],
) -> Answers:
    """Return the answers about the relations in the mask."""
    index = index_of_ids(scene)
    answers = [
        (entry["probability"], canonical_triple(index, entry))
        for entry in relations(artifact, scene)["relations"]
    ]
    return [(p, bool(encoded.instance_holds[triple])) for p, triple in answers if mask[triple]]


def ask_placements(artifact: SceneModel, encoded: EncodedScene, rng: Rng) -> Answers | None:
    """Ask where an instance of a removed class belongs, for up to `_REMOVALS` removals."""
    is_annotated = annotated_relations(encoded)
    answers: Answers = []
    for _ in range(_REMOVALS if is_annotated.any() else 0):
        removal = removed_class(encoded, artifact.vocabulary.structure, rng)
        if removal is None:
            continue
        target, kept = removal
        removed = int(rng.choice(np.flatnonzero(encoded.instance_classes == target)))
        scene = labels_alone(encoded, kept)
        index = index_of_ids(scene)
        for entry in missing(artifact, scene, candidates=[target])["missing"]:
            for place in entry["placements"]:
                triple = canonicalise(removed, place["relation"], kept[index[place["object"]]])
                if is_annotated[triple]:
                    answers.append((place["probability"], bool(encoded.instance_holds[triple])))
    return answers or None


def collect_missing(
    artifact: SceneModel, scenes: SceneTensors, size: Size, seed: int = 0, *, stated: bool = False
) -> tuple[Scored | None, int]:
    """Ask for the missing classes of random parts of this size, as `collect` does.

    With `stated`, each request states the coverage: 1 if one class is hidden, otherwise the share.
    """
    structure = torch.from_numpy(artifact.vocabulary.structure.copy())
    parts = draw_parts(scenes, structure, size, (seed,))
    can_show = scenes.annotated_classes[scenes.source[parts.scene]].numpy()
    items: list[tuple[int, float, bool]] = []
    for row, (k, v) in enumerate(zip(parts.scene.tolist(), parts.v, strict=True)):
        listed, hidden = v.nonzero().squeeze(1).tolist(), int(parts.hidden[row].sum())
        share = 1.0 if hidden == 1 else len(listed) / (len(listed) + hidden)
        coverage = share if stated else None
        answer = missing(artifact, of_classes(listed), coverage=coverage, details=False)
        for entry in answer["missing"]:
            index = artifact.vocabulary.index(entry["label"])
            if can_show[row, index]:
                items.append((k, entry["probability"], bool(parts.hidden[row, index])))
    return scored(items, len(scenes)), parts.skipped


class PlaceQuestion(NamedTuple):
    """A question about the hidden classes at a place of a scene."""

    scene: Scene
    place: Place
    placed: Bool[NDArray, " V"]  # hidden classes at the place
    # Neither structure, nor listed, nor hidden with an unknown relation to the anchor.
    usable: Bool[NDArray, " V"]


def place_question(
    vocabulary: Vocabulary, encoded: EncodedScene, rng: Rng, relations: Collection[int]
) -> PlaceQuestion | None:
    """Draw a part of a scene and a place at one of its objects; None if there is none."""
    structure, classes = vocabulary.structure, encoded.evidence.classes
    order = rng.permutation(classes[~structure[classes]])
    listed = up_to_longest(len(order), rng) if encoded.complete else 0
    if not listed:
        return None
    hidden = order[listed:]
    is_hidden = np.isin(encoded.instance_classes, hidden)
    place = occupied_place(encoded, structure, ~is_hidden, rng, relations)
    if place is None:
        return None
    relation, anchor = place
    kept = thing_instances(encoded, structure, hidden)
    placed, unannotated = np.zeros((2, len(structure)), dtype=np.bool_)
    placed[encoded.instance_classes[encoded.instance_holds[relation, :, anchor] & is_hidden]] = True
    is_annotated = annotated_relations(encoded)[relation, :, anchor]
    unannotated[encoded.instance_classes[~is_annotated & is_hidden]] = True
    usable = ~structure & ~(unannotated & ~placed)
    usable[encoded.instance_classes[kept]] = False
    at = Place(relation, kept.index(anchor), outgoing=True)
    return PlaceQuestion(labels_alone(encoded, kept), at, placed, usable)


def ask_placed(artifact: SceneModel, encoded: EncodedScene, rng: Rng) -> Answers | None:
    """Ask for the hidden classes at one place, without those of an unknown relation."""
    question = place_question(artifact.vocabulary, encoded, rng, range(artifact.spec.A))
    if question is None:
        return None
    at = CANONICAL[question.place.relation], question.place.anchor
    labels = artifact.vocabulary.labels
    entries = missing(artifact, question.scene, at=at, details=False)["missing"]
    answers = [(entry["probability"], labels.index(entry["label"])) for entry in entries]
    return [(p, bool(question.placed[index])) for p, index in answers if question.usable[index]]


def ask_outliers(
    artifact: SceneModel,
    encoded: EncodedScene,
    rng: Rng,
    intruders: Mapping[tuple[str, str], Int[NDArray, " choices"]] | None = None,
) -> Answers | None:
    """Ask for the outliers of a random part. Half of the parts contain an intruder.

    `intruders` is the result of `draw_intruder_choices`; None allows any absent class.
    """
    structure, classes = artifact.vocabulary.structure, encoded.evidence.classes
    things = classes[~structure[classes]]
    if not encoded.complete or len(things) < 3:
        return None
    if intruders is None:
        candidates = np.setdiff1d(np.flatnonzero(~structure), classes)
    else:
        candidates = intruders[encoded.source, encoded.scene_id]
    if not len(candidates):
        return None
    order = rng.permutation(things)
    hidden = order[up_to_longest(len(order), rng) :]
    scene, intruder = labels_alone(encoded, thing_instances(encoded, structure, hidden)), -1
    if rng.random() < 0.5:
        intruder = len(scene.objects)
        scene = with_intruder(artifact, scene, int(rng.choice(candidates)))
    index = index_of_ids(scene)
    return [
        (entry["probability"], index[entry["object"]] == intruder)
        for entry in outliers(artifact, scene, details=False)["outliers"]
    ] or None


def ask_misplaced(artifact: SceneModel, encoded: EncodedScene, rng: Rng) -> Answers | None:
    """Ask for misplaced relations. One relation is altered in half of the scenes."""
    case = altered_case(encoded, artifact.vocabulary.structure, rng)
    if case is None:
        return None
    scene, false = case
    index = index_of_ids(scene)
    return [
        (entry["probability"], canonical_triple(index, entry) == false)
        for entry in misplaced(artifact, replace(scene, room_type=None))
    ] or None


# Sizes of the lists in questions about missing classes, and whether the requests state the share.
LISTED: dict[str, tuple[Size, bool]] = {
    **{f"missing, {listed} classes": (exactly(listed), False) for listed in (2, 4, 8)},
    **{f"missing, {share:.0%} stated": (share_of(share), True) for share in (0.25, 0.5, 0.75)},
    "missing, all but one": (all_but_one, True),
}

QUESTIONS: dict[str, Ask] = {
    "relations": ask_relations,
    "relations, others given": ask_given,
    "placements": ask_placements,
    "missing at a place": ask_placed,
    "outliers": ask_outliers,
    "misplaced": ask_misplaced,
}

NAMES = (*QUESTIONS, *LISTED)  # names of all questions in the metrics of the task


def calibration_task(artifact: SceneModel, setting: Setting) -> Outcome | None:
    """Measure the calibration of the answers to all questions, published and uncalibrated."""
    related = setting.some(related=True, share=3)
    complete, complete_related = (
        setting.complete.some(related=related, share=3) for related in (False, True)
    )
    listed, train, seed = setting.complete.some(), setting.complete.train, setting.seed
    intruders = draw_intruder_choices(complete, setting.structure, train, seed)
    ask = QUESTIONS | {"outliers": partial(ask_outliers, intruders=intruders)}
    scenes_of = {"outliers": complete, "missing at a place": complete_related}
    models = {"": artifact, ", uncalibrated": uncalibrated(artifact)}
    metrics: dict[str, Metric] = {}
    skipped = 0
    for name in NAMES:
        scenes = scenes_of.get(name, related) if name in QUESTIONS else listed
        for suffix, model in models.items():
            if name in QUESTIONS:
                answers, skips = collect(model, scenes, ask[name], seed)
            else:
                size, stated = LISTED[name]
                answers, skips = collect_missing(model, scenes, size, seed, stated=stated)
            skipped += 0 if suffix else skips
            if answers is None:
                break
            for figure in ("ECE", "Brier skill"):
                metric = replace(answers, statistic=figure).by(scenes.group_ids)
                metrics[f"{figure}, {name}{suffix}"] = metric
    # Brier skill is undefined if all answers are true or all answers are false.
    metrics = {name: metric for name, metric in metrics.items() if np.isfinite(metric.value)}
    return Outcome(metrics, max(len(related), len(complete)), skipped) if metrics else None
