"""Tasks T3: add an absent class to a scene as an intruder, and look for alarms in untouched parts.

A request lists the classes of a scene and one intruder, without structure and relations. The model
ranks the listed classes by suspicion. The suspicion of a published model is the probability of
`/outliers`. Hit@1 is the share of scenes whose intruder ranks first. For ties, it is the
expectation under random order. An intruder is flagged if the service reports it as an outlier at
the default sensitivity. Each intruder is drawn three times from one of these distributions over
absent classes:

    uniform     all classes have the same probability
    popularity  the probability is proportional to the number of training scenes with the class
    signature   a class that is typical of another room type

Structure classes such as walls are never intruders. Scenes with fewer than three other classes are
skipped.

The lift of a class in a room type is p(class | room type) / p(class), over training scenes with a
known room type. The signature of a room type contains the ten classes with the highest lift, or
fewer. A signature class has a lift of at least 5 and occurs in at least 20 % of the scenes of the
room type. Room types with fewer than 20 training scenes are left out.

In a scene of room type r, a signature intruder is a signature class of another room type, which
occurs in less than 1 % of the training scenes of r. One uniform draw chooses among the room types
with such a class, and another among these classes.

The alarms are measured in random parts of scenes without an intruder, where each alarm is false.
Before publication, a part also states the relations of its two to twelve classes. A model is
refused only if its share of parts with an alarm is certainly too large: the exact 95 % lower bound
must exceed `EXCESS` times the promise of the sensitivity.

T3c: one object of a scene stands at a wrong place. Each scene is asked twice: with a moved object,
and untouched. Scenes with boxes are asked as poses, without relations. An object then stands on
another object, on the floor or under its supporter. Other scenes state at most 40 relations, one of
them an altered support. See `training.datasets.moved`. The room type is not stated. Scenes without
a possible move are skipped.

    named first             share of scenes whose first misplaced relation names the moved object in
                            the field `moved`
    flagged at 5 % alarms   share of scenes in which the highest probability about the moved object
                            exceeds a threshold. At this threshold, at most 5 % of the untouched
                            scenes of the same source have an alarm

A misplaced relation is about the object in its field `moved`. Without this field, it is about its
subject.

Source: Clopper and Pearson, "The use of confidence or fiducial limits illustrated in the case of
the binomial" (1934).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.special import betaincinv
from torch import Tensor

from app import questions
from app.model import SceneModel, Sensitivity
from app.scene import Scene
from training.datasets import EncodedScene
from training.datasets.array_types import Rng
from training.datasets.batches import SceneTensors
from training.datasets.cases import draw_true_relations, scene_of, scene_rng, some_scenes
from training.datasets.moved import moved_scene, untouched_scene
from training.evaluation.asking import SENSITIVITIES, ask_every, ask_rows, thing_instances
from training.evaluation.metrics import Metric, Ratio
from training.evaluation.object_tasks import SEEDS
from training.evaluation.parts import LONGEST, Ranking, draw_parts, exactly
from training.evaluation.setting import (
    Flagged,
    MisplacedScore,
    Model,
    ObjectScore,
    Outcome,
    Setting,
    Structure,
)

LENGTHS: Final = (1, 2, 3, 5, 8)  # numbers of listed classes in which alarms are measured


class Cases(NamedTuple):
    """N lists of the classes of a scene and one intruder."""

    scene: Int[Tensor, " N"]
    v: Float[Tensor, "N V"]
    intruder: Int[Tensor, " N"]


def with_intruders(
    scenes: SceneTensors, structure: Structure, weights: Float[Tensor, "scenes V"] | None
) -> Cases:
    """Add the intruders of the sampling weights to the scenes, for each of `SEEDS`."""
    drawn = torch.stack([draw_intruders(scenes, structure, weights, seed) for seed in SEEDS])
    _, scene = (drawn >= 0).nonzero(as_tuple=True)
    intruder = drawn[drawn >= 0]
    v = (scenes.v[scene] * ~structure).scatter(1, intruder.unsqueeze(1), 1.0)
    return Cases(scene, v, intruder)


def hit_at_1(scenes: SceneTensors, cases: Cases, suspicion: ObjectScore) -> Ratio:
    """Return the share of cases whose intruder ranks first."""
    values = ask_rows(suspicion, cases.v, block=32).masked_fill(cases.v == 0, -torch.inf)
    return Ranking.of(cases.scene, cases.intruder, values, len(scenes)).top(1)


def outliers_task(model: Model, setting: Setting) -> Outcome | None:
    """Measure hit@1, and the share that a published model flags at medium sensitivity."""
    if model.suspicion is None:
        return None
    scenes, structure = setting.some(), setting.structure
    metrics: dict[str, Metric] = {}
    # Number of scenes without an intruder, under the distribution with the fewest such scenes.
    skipped = len(scenes)
    for distribution, weights in intruder_weights(scenes, setting.train).items():
        cases = with_intruders(scenes, structure, weights)
        if not len(cases.scene):
            continue
        hits = metrics[f"hit@1, {distribution}"] = hit_at_1(scenes, cases, model.suspicion)
        skipped = min(skipped, hits.skipped)
        if (flags := model.flags) is not None:
            alarm = ask_rows(lambda v: flags(v, "medium").float(), cases.v)
            is_flagged = alarm.gather(1, cases.intruder.unsqueeze(1)).squeeze(1).numpy()
            share = Ratio.of_items(cases.scene.numpy(), is_flagged, len(scenes))
            metrics[f"flagged, {distribution}"] = share
    return Outcome.over(scenes, metrics, skipped)


def alarms_task(flags: Flagged, setting: Setting) -> Outcome | None:
    """Measure the share of untouched random parts with an alarm, by sensitivity and length."""
    scenes = setting.some()
    metrics: dict[str, Metric] = {}
    skipped = len(scenes)
    for length in LENGTHS:
        parts = draw_parts(scenes, setting.structure, exactly(length), (setting.seed,))
        if not len(parts.v):
            continue
        skipped = min(skipped, parts.skipped)
        for name in SENSITIVITIES:
            alarm = ask_rows(lambda v: flags(v, name).any(1).float(), parts.v).numpy()  # noqa: B023
            metric = Ratio.of_items(parts.scene.numpy(), alarm, len(scenes))
            metrics[f"alarms, {name}, {length} classes"] = metric
    return Outcome.over(scenes, metrics, skipped)


LAWS = ("uniform", "by popularity", "signature")  # distributions of intruders
SIGNATURE = 10  # maximum number of signature classes of a room type

_SCENES = 20
_LIFT = 5.0
_OFTEN = 0.2
_FOREIGN = 0.01


def draw_intruders(
    scenes: SceneTensors,
    structure: Structure,
    weights: Float[Tensor, "scenes V"] | None = None,
    seed: int = 0,
) -> Int[Tensor, " scenes"]:
    """Draw the class of an intruder for each scene by sampling weights; -1 skips the scene."""
    present = scenes.v > 0
    absent = (~present & ~structure).double()
    if weights is not None:
        absent = absent * weights
    is_usable = ((present & ~structure).sum(1) >= 3) & (absent.sum(1) > 0)
    intruders = torch.full((len(scenes),), -1, dtype=torch.int64)
    for k in is_usable.nonzero().squeeze(1).tolist():
        p = absent[k].numpy()
        intruders[k] = int(scene_rng(scenes.scenes[k], seed).choice(len(p), p=p / p.sum()))
    return intruders


def signatures(train: SceneTensors) -> tuple[Bool[NDArray, "C V"], Float[NDArray, "C V"]]:
    """Return a mask of the signature classes of room types, and p(class | room type), else NaN."""
    has_room = (train.room >= 0).numpy()
    v, room = train.v.numpy()[has_room] > 0, train.room.numpy()[has_room]
    share = np.full((int(room.max(initial=-1)) + 1, v.shape[1]), np.nan)
    typical = np.zeros(share.shape, dtype=np.bool_)
    for room_type in np.flatnonzero(np.bincount(room) >= _SCENES):
        share[room_type] = v[room == room_type].mean(0)
        is_frequent = share[room_type] >= _OFTEN
        lift = np.divide(share[room_type], v.mean(0), where=is_frequent, out=np.zeros(v.shape[1]))
        ranked = np.argsort(-lift, kind="stable")[:SIGNATURE]
        typical[room_type, ranked[lift[ranked] >= _LIFT]] = True
    return typical, share


def by_signature(scenes: SceneTensors, train: SceneTensors) -> Float[Tensor, "scenes V"]:
    """Return the sampling probability of each signature intruder of each scene; else 0."""
    typical, share = signatures(train)
    weights, absent = np.zeros(scenes.v.shape), scenes.v.numpy() == 0
    for k, room in enumerate(scenes.room.tolist()):
        if not 0 <= room < len(typical) or np.isnan(share[room]).any():
            continue
        suitable = typical & absent[k] & (share[room] < _FOREIGN)  # by room type and class
        suitable[room] = False
        suitable = suitable[suitable.any(1)]  # room types with such a class
        if len(suitable):  # a uniform room type, and then a uniform class of it
            weights[k] = (suitable / suitable.sum(1, keepdims=True)).mean(0)
    return torch.from_numpy(weights)


def intruder_weights(
    scenes: SceneTensors, train: SceneTensors | None
) -> dict[str, Float[Tensor, "scenes V"] | None]:
    """Return the sampling weights of each law; only uniform without `train`."""
    if train is None:
        return {"uniform": None}
    popularity = train.v.sum(0).expand(len(scenes), -1)
    return dict(zip(LAWS, (None, popularity, by_signature(scenes, train)), strict=True))


def draw_intruder_choices(
    scenes: SceneTensors, structure: Structure, train: SceneTensors | None, seed: int = 0
) -> dict[tuple[str, str], Int[NDArray, " choices"]]:
    """Draw an intruder of each law for each scene, by (source, scene id), for `ask_outliers`.

    A value has the class of the intruder of each law, without the laws that found none. Without
    `train`, the only law is uniform.
    """
    weights = intruder_weights(scenes, train).values()
    # `ask_outliers` uses `seed` itself. Another seed keeps the draws independent.
    columns = [draw_intruders(scenes, structure, weight, seed + 1) for weight in weights]
    rows = torch.stack(columns, 1).numpy()
    names = [(scene.source, scene.scene_id) for scene in scenes.scenes]
    return {name: row[row >= 0] for name, row in zip(names, rows, strict=True)}


ALARMS: dict[Sensitivity, float] = {"low": 0.02, "medium": 0.1, "high": 0.2}
"""Promised maximum share of parts with an alarm about an object, and about a relation."""

EXCESS = 1.5

_GROUPS = 30  # minimum number of groups of a source with its own count of alarms


@dataclass(frozen=True)
class Alarms:
    """Number of scenes of a source, one of each group, and of those with an alarm."""

    source: str
    about: str  # "objects" or "relations"
    sensitivity: Sensitivity
    scenes: int
    alarms: int

    @property
    def at_least(self) -> float:
        """Exact 95 % lower bound of the share of scenes with an alarm."""
        if self.alarms == 0:
            return 0.0
        return float(betaincinv(self.alarms, self.scenes - self.alarms + 1, 0.05))

    def objection(self) -> str | None:
        """Return the reason against the model, or None if the share may agree with the promise."""
        promise = ALARMS[self.sensitivity]
        if self.at_least <= EXCESS * promise:
            return None
        return (
            f"/outliers raises alarms about {self.about} in {self.alarms} of {self.scenes} "
            f"untouched scenes of {self.source} at {self.sensitivity} sensitivity, which promises "
            f"at most {promise:.0%}. Check the labels and relations, or provide more scenes"
        )


def untouched_alarms(artifact: SceneModel, scenes: Sequence[EncodedScene]) -> Iterator[Alarms]:
    """Count the scenes with an alarm about an untouched part, one random scene of each group.

    Objects count only if the object list is complete. Sources of few groups count together.
    """
    rng = np.random.default_rng(0)
    scene_of_group: dict[tuple[str, str], EncodedScene] = {}
    for k in rng.permutation(len(scenes)).tolist():
        scene_of_group.setdefault((scenes[k].source, scenes[k].group), scenes[k])
    groups = Counter(source for source, _ in scene_of_group)
    cases: dict[str, list[tuple[Scene, bool]]] = {}
    for encoded in scene_of_group.values():
        listed = _random_part(encoded, artifact.vocabulary.structure, rng)
        is_small = len(groups) > 1 and groups[encoded.source] < _GROUPS
        source = "the smaller sources" if is_small else encoded.source
        cases.setdefault(source, []).append((listed, encoded.complete))
    for source, sensitivity in product(sorted(cases), ALARMS):
        alarms = []
        for scene, complete in cases[source]:
            answer = questions.outliers(artifact, scene, sensitivity=sensitivity, details=False)
            of_objects = complete and any(entry["is_outlier"] for entry in answer["outliers"])
            of_relations = any(entry["is_misplaced"] for entry in answer["misplaced"])
            alarms.append((of_objects, of_relations))
        for about, flags in zip(("objects", "relations"), zip(*alarms, strict=True), strict=True):
            yield Alarms(source, about, sensitivity, len(flags), sum(flags))


def _random_part(encoded: EncodedScene, structure: Bool[NDArray, " V"], rng: Rng) -> Scene:
    """Return the instances of two to `LONGEST` random classes, with their relations."""
    classes = encoded.evidence.classes
    order = rng.permutation(classes[~structure[classes]])
    hidden = order[rng.integers(2, min(LONGEST, max(len(order), 2)) + 1) :]  # not in the part
    kept = thing_instances(encoded, structure, hidden)
    index_of = {instance: index for index, instance in enumerate(kept)}
    triples = [
        (a, index_of[i], index_of[j])
        for a, i, j in draw_true_relations(encoded, structure, rng) or ()
        if i in index_of and j in index_of
    ]
    return replace(scene_of(encoded, kept, triples), room_type=None)


MOVED: Final = ("named first", "flagged at 5 % alarms")

_ALARM_SHARE: Final = 0.05  # of untouched scenes with an alarm at the threshold
_MOVED_SCENES: Final = 300  # maximum number of scenes of a source


@dataclass(frozen=True, eq=False)
class MovedCase:
    """A scene with the moved object `object`, and the same scene without the move."""

    scene_index: int
    moved: Scene
    object: str
    untouched: Scene


def moved_cases(scenes: SceneTensors, structure: Structure, seed: int = 0) -> list[MovedCase]:
    """Return a case for each scene in which an object can move."""
    is_structure = structure.numpy()
    cases = []
    for scene_index, encoded in enumerate(scenes.scenes):
        case = moved_scene(encoded, is_structure, scene_rng(encoded, seed))
        untouched = untouched_scene(encoded, is_structure, scene_rng(encoded, seed))
        if case is not None and untouched is not None:
            scene, index = case
            scene, untouched = (replace(entry, room_type=None) for entry in (scene, untouched))
            cases.append(MovedCase(scene_index, scene, scene.objects[index].id, untouched))
    return cases


def ask_moved(score: MisplacedScore, cases: Sequence[MovedCase]) -> Float[NDArray, "N 3"]:
    """Return the answers to N cases.

    The columns are 1 if the moved object is named first, the highest probability about the moved
    object, and that in the untouched scene; 0 without an entry.
    """

    def ask(case: MovedCase) -> Float[NDArray, " 3"]:
        entries, untouched = score(case.moved), score(case.untouched)
        is_first = bool(entries) and entries[0].get("moved") == case.object
        return np.array([is_first, _highest(entries, case.object), _highest(untouched)])

    return np.array(ask_every(ask, cases)).reshape(-1, 3)


def _highest(entries: Sequence[Mapping[str, Any]], object_: str | None = None) -> float:
    """Return the highest probability of the entries about an object; None means all entries."""
    values = [
        float(entry["probability"])
        for entry in entries
        if object_ is None or (entry.get("moved") or entry["subject"]) == object_
    ]
    return max(values, default=0.0)


def flagged(
    suspicion: Float[NDArray, " N"], untouched: Float[NDArray, " N"], source: Int[NDArray, " N"]
) -> Bool[NDArray, " N"]:
    """Return whether each suspicion exceeds the threshold of its source; see `ask_moved`."""
    is_flagged = np.zeros(len(source), dtype=np.bool_)
    for name in np.unique(source):
        in_source = source == name
        threshold = np.sort(untouched[in_source])[-1 - int(_ALARM_SHARE * in_source.sum())]
        is_flagged[in_source] = suspicion[in_source] > threshold
    return is_flagged


def moved_task(score: MisplacedScore, setting: Setting) -> Outcome | None:
    """Measure T3c: the shares of moved objects that are named first, and flagged."""
    scenes = some_scenes(setting.some(related=True), _MOVED_SCENES, setting.seed)
    cases = moved_cases(scenes, setting.structure, setting.seed)
    if not cases:
        return None
    first, suspicion, untouched = ask_moved(score, cases).T
    index = np.array([case.scene_index for case in cases])
    values = first, flagged(suspicion, untouched, scenes.source.numpy()[index])
    metrics: dict[str, Metric] = {
        name: Ratio.of_items(index, value, len(scenes))
        for name, value in zip(MOVED, values, strict=True)
    }
    return Outcome.over(scenes, metrics, len(scenes) - len(cases))
