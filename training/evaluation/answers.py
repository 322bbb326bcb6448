"""Calibration: what the service answers with a probability, and whether it was so.

Each answer means what the contract says of it: an annotator would list the relation for this pair
(of objects that are there, whatever is known of others, or of one that is not with one that is);
the class was taken away, given that exactly one was (and where it stood); the object is an
intruder, where half of the scenes are clean; the relation is false, where one was altered in half
of the scenes. Requests name no room type and take every default, so only answers returned count.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from app.reasoning import misplaced, missing, outliers, relations
from app.registry import Artifact, Calibration, CountSlope, Slope
from app.scene import CANONICAL, Scene, SceneObject, canonicalise
from training.batches import SceneTensors
from training.cases import (
    altered_case,
    placed_case,
    scene_of,
    taken_away,
    told_pairs,
)
from training.datasets import EncodedScene
from training.evaluation.cases import scene_rng
from training.evaluation.metrics import Scored

# An object has three places, where a scene has twenty relations: of one object a scene there are so
# few answers that chance alone makes an ECE of .02 to .03.
_REMOVALS = 4
# (probability, whether it was so) of the answers to one scene.
Answered = list[tuple[float, bool]]


@dataclass(frozen=True, eq=False)
class Answers:
    """All answers of one kind.

    Attributes:
        scene: (N,) position; probability: (N,); truth: (N,) bool.
        scenes, skipped: how many were given, and how many could not be asked.
    """

    scene: NDArray[np.int64]
    probability: NDArray[np.float64]
    truth: NDArray[np.bool_]
    scenes: int
    skipped: int

    def ece(self) -> Scored:
        """Expected calibration error in bins of equal mass."""
        return Scored("ECE", self.scene, self.probability, self.truth, self.scenes)

    def brier_skill(self) -> Scored:
        """Brier skill against the base rate of these answers."""
        return Scored("Brier skill", self.scene, self.probability, self.truth, self.scenes)


def uncalibrated(artifact: Artifact) -> Artifact:
    """The artifact with log-odds taken as they are, only their signs made to fit the answers."""
    plain = Calibration.neutral(artifact.machine.spec.A).model_copy(
        update={"outlier": CountSlope(slope=-1.0), "misplaced": Slope(slope=-1.0)}
    )
    return replace(artifact, calibration=plain)


def collect(
    artifact: Artifact,
    scenes: SceneTensors,
    ask: Callable[[Artifact, EncodedScene, np.random.Generator], Answered | None],
    seed: int = 0,
) -> Answers:
    """Ask one question (see `QUESTIONS`) of every scene."""
    place: list[int] = []
    probability: list[float] = []
    truth: list[bool] = []
    skipped = 0
    for k, scene in enumerate(scenes.scenes):
        found = ask(artifact, scene, scene_rng(scene, seed))
        if found is None:
            skipped += 1
            continue
        for p, so in found:
            place.append(k)
            probability.append(p)
            truth.append(so)
    return Answers(
        np.array(place, dtype=np.int64),
        np.array(probability),
        np.array(truth, dtype=np.bool_),
        len(scenes),
        skipped,
    )


def ask_relations(
    artifact: Artifact,
    encoded: EncodedScene,
    rng: np.random.Generator,  # noqa: ARG001
) -> Answered | None:
    """Relations of a scene's objects, if it is annotated; what is not listed does not hold."""
    if not encoded.instance_observed.any():
        return None
    found: Answered = []
    answers, _ = relations(artifact, _bare(encoded, range(len(encoded.instance_classes))))
    for answer in answers:
        triple = CANONICAL.index(answer.relation), answer.subject, answer.object
        found.append((answer.probability, bool(encoded.instance_holds[triple])))
    return found


def ask_given(
    artifact: Artifact, encoded: EncodedScene, rng: np.random.Generator
) -> Answered | None:
    """Relations between some pairs of a scene, given those between the others."""
    asked, given = told_pairs(encoded, artifact.vocabulary.structure, rng)
    if not given:
        return None
    scene = replace(scene_of(encoded, range(len(asked)), given), room_type=None)
    found: Answered = []
    for answer in relations(artifact, scene)[0]:
        triple = CANONICAL.index(answer.relation), answer.subject, answer.object
        if asked[triple[1:]]:
            found.append((answer.probability, bool(encoded.instance_holds[triple])))
    return found or None


def ask_placements(
    artifact: Artifact, encoded: EncodedScene, rng: np.random.Generator
) -> Answered | None:
    """Where an object that was taken away stood, one instance of it; several times over."""
    found: Answered = []
    if encoded.instance_observed.any():
        for _ in range(_REMOVALS):
            found += _places_of_one(artifact, encoded, rng)
    return found or None


def _places_of_one(artifact: Artifact, encoded: EncodedScene, rng: np.random.Generator) -> Answered:
    taken = taken_away(encoded, artifact.vocabulary.structure, rng)
    if taken is None:
        return []
    target, kept = taken
    gone = int(rng.choice(np.flatnonzero(encoded.instance_classes == target)))
    found: Answered = []
    for answer in missing(artifact, _bare(encoded, kept), candidates=[target]):
        for place in answer.placements:
            a, subject, _ = canonicalise(gone, place.relation, kept[place.object])
            pair = (gone, kept[place.object]) if subject == gone else (kept[place.object], gone)
            found.append((place.probability, bool(encoded.instance_holds[(a, *pair)])))
    return found


def ask_missing(
    artifact: Artifact, encoded: EncodedScene, rng: np.random.Generator
) -> Answered | None:
    """The class that was taken away."""
    taken = taken_away(encoded, artifact.vocabulary.structure, rng)
    if taken is None:
        return None
    target, kept = taken
    label = artifact.vocabulary.labels[target]
    found = missing(artifact, _bare(encoded, kept), details=False)
    return [(answer.probability, answer.label == label) for answer in found]


def ask_placed(
    artifact: Artifact, encoded: EncodedScene, rng: np.random.Generator
) -> Answered | None:
    """The class that was taken away, given where it stood."""
    case = placed_case(encoded, artifact.vocabulary.structure, rng)
    if case is None:
        return None
    scene, relation, anchor, target = case
    scene = replace(scene, room_type=None)
    label = artifact.vocabulary.labels[target]
    found = missing(artifact, scene, at=(CANONICAL[relation], anchor), details=False)
    return [(answer.probability, answer.label == label) for answer in found]


def ask_outliers(
    artifact: Artifact, encoded: EncodedScene, rng: np.random.Generator
) -> Answered | None:
    """Which object is the intruder, if there is one."""
    structure = artifact.vocabulary.structure
    classes = encoded.evidence.classes
    if (~structure[classes]).sum() < 3:
        return None
    scene = _bare(encoded, range(len(encoded.instance_classes)))
    intruder = -1
    if rng.random() < 0.5:
        absent = np.setdiff1d(np.flatnonzero(~structure), classes)
        c = int(rng.choice(absent))
        intruder = len(scene.objects)
        thing = SceneObject(id="intruder", label=artifact.vocabulary.labels[c], class_index=c)
        scene = replace(scene, objects=(*scene.objects, thing))
    found = outliers(artifact, scene, details=False).outliers
    usable = [not structure[thing.class_index] for thing in scene.objects]
    return [(a.probability, a.object == intruder) for a in found if usable[a.object]]


def ask_misplaced(
    artifact: Artifact, encoded: EncodedScene, rng: np.random.Generator
) -> Answered | None:
    """Which relation is false, if one is."""
    case = altered_case(encoded, artifact.vocabulary.structure, rng)
    if case is None:
        return None
    scene, false = case
    found = misplaced(artifact, replace(scene, room_type=None))
    return [
        (a.probability, (CANONICAL.index(a.relation), a.subject, a.object) == false) for a in found
    ]


QUESTIONS: dict[str, Callable[[Artifact, EncodedScene, np.random.Generator], Answered | None]] = {
    "relations": ask_relations,
    "relations, others given": ask_given,
    "placements": ask_placements,
    "missing": ask_missing,
    "missing at a place": ask_placed,
    "outliers": ask_outliers,
    "misplaced": ask_misplaced,
}


def _bare(encoded: EncodedScene, kept: range | list[int]) -> Scene:
    return replace(scene_of(encoded, list(kept), triples=()), room_type=None)
