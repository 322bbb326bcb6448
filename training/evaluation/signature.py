"""T3 signature: an intruder that is typical of another room type; and alarms by sensitivity.

The lift of a class in a room type is p(class | room type) / p(class), by shares of training scenes
whose room type is known. A room type's signature are the ten classes of highest lift there, of
those in at least a fifth of its scenes and with a lift of at least 5: often there, seldom
elsewhere. The intruder of a scene of room type r is drawn in two steps: uniformly one of the other
room types that have a suitable class, then uniformly one of its suitable ones: signature classes
that are absent from the scene, no structure, and in less than 1 % of the training scenes of type r.
Room types of under 20 training scenes are left out, and so are scenes under three classes.

A published model is asked as a robot asks: all instances of the scene as labels, nothing else.
hit@1 then follows the service's ranking, the probability of being an intruder; hit@1 by log-odds
stands beside it. Structure raises no alarm and takes no rank. Ties score their expectation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from app.questions import Sensitivity
from app.registry import Artifact
from app.scene import Scene, SceneObject
from training.batches import SceneTensors
from training.datasets import EncodedScene
from training.evaluation.asking import SENSITIVITIES, ask_every, judge, labels_alone, things
from training.evaluation.cases import scene_rng
from training.evaluation.contenders import Contender
from training.evaluation.intervals import Metric
from training.evaluation.metrics import Ratio
from training.evaluation.outliers import by_popularity, draw_intruders, intruder_scores
from training.evaluation.setting import Outcome, Setting
from training.trainer import subset

SIGNATURE = 10
"""Classes that a room type is known by, at most."""

_SCENES = 20
_LIFT = 5.0
_OFTEN = 0.2
_FOREIGN = 0.01

Law = Callable[[SceneTensors, SceneTensors], Tensor]

# Lists of so few classes are asked too: a robot that has just begun to look.
_SHORT_LISTS = (1, 2, 4)


@dataclass(frozen=True, eq=False)
class Signatures:
    """What training scenes say of R room types.

    Attributes:
        typical: (R, V) bool, the signature of each.
        share: (R, V) p(class | room type), nan for a room type of too few scenes.
    """

    typical: NDArray[np.bool_]
    share: NDArray[np.float64]


def signatures(train: SceneTensors) -> Signatures:
    """The signature of every room type."""
    known = (train.room >= 0).numpy()
    v, room = train.v.numpy()[known] > 0, train.room.numpy()[known]
    rooms = int(room.max(initial=-1)) + 1
    share = np.full((rooms, v.shape[1]), np.nan)
    typical = np.zeros(share.shape, dtype=np.bool_)
    popularity = v.mean(0) if len(v) else np.zeros(v.shape[1])
    for r in range(rooms):
        own = v[room == r]
        if len(own) < _SCENES:
            continue
        share[r] = own.mean(0)
        often = share[r] >= _OFTEN
        lift = np.divide(share[r], popularity, where=often, out=np.zeros(v.shape[1]))
        best = np.argsort(-lift, kind="stable")[:SIGNATURE]
        typical[r, best[lift[best] >= _LIFT]] = True
    return Signatures(typical, share)


def by_signature(scenes: SceneTensors, train: SceneTensors) -> Tensor:
    """Weights (N, V): the probability of each class to be drawn; 0 throughout for no intruder."""
    found = signatures(train)
    weights = np.zeros(scenes.v.shape)
    absent = scenes.v.numpy() == 0
    for k, room in enumerate(scenes.room.tolist()):
        if not 0 <= room < len(found.typical) or np.isnan(found.share[room]).any():
            continue
        suitable = found.typical & absent[k] & (found.share[room] < _FOREIGN)
        suitable[room] = False
        sizes = suitable.sum(1)
        some = sizes > 0
        if some.any():
            weights[k] = (suitable[some] / sizes[some, None]).mean(0)
    return torch.from_numpy(weights)


@dataclass(frozen=True, eq=False)
class Judged:
    """Scenes with an intruder, as the service judges them.

    Attributes:
        asked: (scenes,) bool, which were; scores: of those, in their order, (n, 3) of the scored
            objects: probability, log-odds, whether it is the intruder.
        flagged: by sensitivity (scenes,) bool, the intruder is called an outlier.
    """

    asked: NDArray[np.bool_]
    scores: list[NDArray[np.float64]]
    flagged: dict[str, NDArray[np.bool_]]

    def hit_at_1(self, column: int = 0) -> Ratio:
        """The intruder is the likeliest outlier; by log-odds for column 1, lowest first."""
        hits = np.zeros(len(self.asked))
        for k, scores in zip(np.flatnonzero(self.asked), self.scores, strict=True):
            value = -scores[:, 1] if column else scores[:, 0]
            first = value == value.max()
            hits[k] = scores[first, 2].mean()
        return Ratio(hits, self.asked.astype(np.float64))

    def caught(self, sensitivity: str) -> Ratio:
        """Share of intruders that are called outliers."""
        return Ratio(self.flagged[sensitivity].astype(np.float64), self.asked.astype(np.float64))


def judge_intruders(
    artifact: Artifact, scenes: SceneTensors, structure: Tensor, intruders: Tensor
) -> Judged:
    """Ask for every scene with its intruder, (N,) classes, -1 where there is none.

    Raises:
        LeakError: see `ask_every`.
    """
    asked = (intruders >= 0).numpy()
    places = np.flatnonzero(asked).tolist()
    cases = [
        with_intruder(artifact, labels_alone(scenes.scenes[k]), int(intruders[k])) for k in places
    ]
    scored: list[NDArray[np.float64]] = []
    flagged: dict[str, NDArray[np.bool_]] = {
        name: np.zeros(len(asked), dtype=np.bool_) for name in SENSITIVITIES
    }
    plain = [things(case, structure.numpy()) for case in cases]
    for name in SENSITIVITIES:
        found = ask_every(partial(verdict, artifact, name), cases)
        for k, columns in zip(places, found, strict=True):
            flagged[name][k] = columns[-1, 2] > 0
        if name == "medium":
            scored = [
                np.column_stack([columns[:, :2], np.arange(len(columns)) == len(columns) - 1])[own]
                for columns, own in zip(found, plain, strict=True)
            ]
    return Judged(asked, scored, flagged)


def verdict(artifact: Artifact, sensitivity: Sensitivity, scene: Scene) -> NDArray[np.float64]:
    """(n, 3) of its objects: probability, log-odds, called an outlier."""
    found = judge(artifact, scene, sensitivity)
    return np.column_stack([found.probability, found.log_odds, found.is_outlier])


def with_intruder(artifact: Artifact, scene: Scene, intruder: int) -> Scene:
    """The scene with one more object, of a class that it lacks."""
    thing = SceneObject("intruder", artifact.vocabulary.labels[intruder], intruder)
    return replace(scene, objects=(*scene.objects, thing))


def alarms(
    artifact: Artifact,
    cases: Sequence[Scene],
    structure: Tensor,
    sensitivity: Sensitivity,
    judged: NDArray[np.bool_],
) -> Ratio:
    """Share of the judged of N untouched scenes with an object that is called an outlier."""
    found = ask_every(partial(verdict, artifact, sensitivity), cases)
    loud = np.array(
        [
            bool(((columns[:, 2] > 0) & things(case, structure.numpy())).any())
            for case, columns in zip(cases, found, strict=True)
        ]
    )
    return Ratio((loud & judged).astype(np.float64), judged.astype(np.float64))


def first_classes(
    encoded: EncodedScene, structure: Tensor, listed: int, rng: np.random.Generator
) -> Scene:
    """All instances of so many of its classes, drawn at random, and its structure."""
    every = np.unique(encoded.instance_classes)
    hidden = rng.permutation(every[~structure.numpy()[every]])[listed:]
    kept = np.flatnonzero(~np.isin(encoded.instance_classes, hidden))
    return labels_alone(encoded, kept.tolist())


def signature_task(contender: Contender, setting: Setting) -> Outcome | None:
    """T3 signature; a baseline ranks by log-odds alone."""
    if setting.train is None:
        return None
    every = by_signature(setting.scenes, setting.train)
    drawn = draw_intruders(setting.scenes, setting.structure, every, setting.seed)
    index = (drawn >= 0).nonzero().squeeze(1)
    if not len(index):
        return None
    scenes = replace(setting, scenes=subset(setting.scenes, index)).some()
    own = by_signature(scenes, setting.train)
    if contender.artifact is None:
        if contender.objects is None:
            return None
        scores = intruder_scores(
            scenes, setting.structure, contender.objects, weights=own, seed=setting.seed
        )
        hit = scores.hit_at_1()
        return Outcome({"hit@1": hit, "hit@1, log-odds alone": hit}, len(scenes), 0)
    intruders = draw_intruders(scenes, setting.structure, own, setting.seed)
    judged = judge_intruders(contender.artifact, scenes, setting.structure, intruders)
    metrics: dict[str, Metric] = {
        "hit@1": judged.hit_at_1(),
        "hit@1, log-odds alone": judged.hit_at_1(1),
    }
    metrics |= {f"caught, {name}": judged.caught(name) for name in SENSITIVITIES}
    return Outcome(metrics, len(scenes), 0)


def sensitivity_task(contender: Contender, setting: Setting) -> Outcome | None:
    """Alarms in untouched scenes, and intruders caught, at each sensitivity."""
    artifact = contender.artifact
    if artifact is None:
        return None
    scenes, structure = setting.some(), setting.structure
    laws: dict[str, Tensor | None] = {"uniform": None}
    if setting.train is not None:
        laws["by popularity"] = by_popularity(scenes, setting.train)
    metrics: dict[str, Metric] = {}
    judged_scenes = np.zeros(len(scenes), dtype=np.bool_)
    for name, weights in laws.items():
        intruders = draw_intruders(scenes, structure, weights, setting.seed)
        if not (intruders >= 0).any():
            continue
        judged = judge_intruders(artifact, scenes, structure, intruders)
        judged_scenes |= judged.asked
        metrics[f"hit@1, {name}"] = judged.hit_at_1()
        metrics[f"hit@1, {name}, log-odds alone"] = judged.hit_at_1(1)
        for sensitivity in SENSITIVITIES:
            metrics[f"caught, {name}, {sensitivity}"] = judged.caught(sensitivity)
    if not metrics:
        return None
    cases = [labels_alone(scene) for scene in scenes.scenes]
    for sensitivity in SENSITIVITIES:
        metrics[f"alarms, {sensitivity}"] = alarms(
            artifact, cases, structure, sensitivity, judged_scenes
        )
    plain = (scenes.v > 0) & ~structure
    for listed in _SHORT_LISTS:
        large = judged_scenes & (plain.sum(1) > listed).numpy()
        if not large.any():
            continue
        cases = [
            first_classes(scene, structure, listed, scene_rng(scene, setting.seed))
            for scene in scenes.scenes
        ]
        metrics[f"alarms, medium, {listed} listed"] = alarms(
            artifact, cases, structure, "medium", large
        )
    return Outcome(metrics, len(scenes), int((~judged_scenes).sum()))
