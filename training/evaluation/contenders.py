"""What is evaluated: a machine or a baseline, as one callable for each task that it can answer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

from app.registry import Artifact
from training.batches import SceneTensors
from training.evaluation.alarms import Alarm, calibrated_alarm
from training.evaluation.density import DensitySettings, ObjectDensity, machine_density
from training.evaluation.generation import Sampler
from training.evaluation.missing import ObjectScore, RoomScore, machine_score
from training.evaluation.placed import PlacedScore
from training.evaluation.relations import RelationScore
from training.evaluation.sampling import machine_sampler
from training.evaluation.scores import placed_score, relation_score
from training.machines import BoltzmannMachine
from training.machines.arrays import machine_of


@dataclass(frozen=True, eq=False)
class Contender:
    """One row of the tables; None where it does not take part.

    Attributes:
        objects: T2 and T3.
        relations: T1a.
        completion: T1b; gets the given triples as the batch's relations.
        placed: T2-at.
        placement: T3b; gets the triples, a false one among them, as the batch's relations.
        sampler: T4.
        density: Density; called once, when it is needed.
        alarm: T3, the share of untouched scenes that raise one.
        artifact: Calibration.
        objects_in_rooms: T2 where the room type is given.
        machine: the seed protocol, which samples.
        parameters: number of trained weights, None where that says nothing.
    """

    objects: ObjectScore | None = None
    relations: RelationScore | None = None
    completion: RelationScore | None = None
    placed: PlacedScore | None = None
    placement: RelationScore | None = None
    sampler: Sampler | None = None
    density: Callable[[], ObjectDensity] | None = None
    alarm: Alarm | None = None
    artifact: Artifact | None = None
    objects_in_rooms: RoomScore | None = None
    machine: BoltzmannMachine | None = None
    parameters: int | None = None


def artifact_contender(
    artifact: Artifact,
    train: SceneTensors,
    settings: DensitySettings = DensitySettings(),  # noqa: B008
    seed: int = 0,
    *,
    calibrated: bool = True,
) -> Contender:
    """A model, published or in memory.

    Args:
        train: training scenes, for the density's annealing.
        calibrated: ask for its probabilities and its alarm too; otherwise only the scores that a
            machine has without a calibration.
    """
    machine = machine_of(artifact.weights)
    objects, completion = machine_score(machine), relation_score(artifact, given=True)
    density = None
    if not machine.relations_act:
        density = cache(partial(machine_density, machine, train, settings, seed))
    return Contender(
        objects=objects,
        relations=relation_score(artifact, given=False),
        completion=completion,
        placed=placed_score(artifact),
        placement=completion,
        sampler=machine_sampler(machine),
        density=density,
        objects_in_rooms=objects if machine.spec.C else None,
        machine=machine,
        parameters=machine.parameter_count,
        alarm=calibrated_alarm(artifact.calibration) if calibrated else None,
        artifact=artifact if calibrated else None,
    )
