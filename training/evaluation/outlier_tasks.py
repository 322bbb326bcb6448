"""Task T3: add an absent class to a scene as an intruder, and look for alarms in untouched parts.

A request lists the classes of a scene and one intruder, without structure and relations. The model
ranks the listed classes by suspicion. The suspicion of a published model is the probability of
`/outliers`. Hit@1 is the share of scenes whose intruder ranks first. For ties, it is the
expectation under random order. An intruder is flagged if the service reports it as an outlier at
the default sensitivity. Each intruder is drawn three times.

The alarms are measured in random parts of scenes without an intruder, where each alarm is false.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from training.datasets.batches import SceneTensors
from training.evaluation.asking import SENSITIVITIES, ask_rows
from training.evaluation.intruders import draw_intruders, intruder_weights
from training.evaluation.metrics import Metric, Ratio
from training.evaluation.missing_tasks import SEEDS
from training.evaluation.model import Flagged, Model, ObjectScore
from training.evaluation.parts import draw_parts, exactly
from training.evaluation.setting import Outcome, Setting, Structure

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


def expected_hit_at_1(
    values: Float[Tensor, "N V"], target: Int[Tensor, " N"]
) -> Float[NDArray, " N"]:
    """Return 1 where the target has the highest value of its row; 1/m for m highest values."""
    is_highest = values == values.max(1, keepdim=True).values
    hit = is_highest.gather(1, target.unsqueeze(1)).squeeze(1)
    return (hit / is_highest.sum(1)).double().numpy()


def hit_at_1(scenes: SceneTensors, cases: Cases, suspicion: ObjectScore) -> Ratio:
    """Return the share of cases whose intruder ranks first."""
    values = ask_rows(suspicion, cases.v, block=32).masked_fill(cases.v == 0, -torch.inf)
    hits = expected_hit_at_1(values, cases.intruder)
    return Ratio.of_items(cases.scene.numpy(), hits, len(scenes))


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
            flagged = ask_rows(lambda v: flags(v, "medium").float(), cases.v)
            is_flagged = flagged.gather(1, cases.intruder.unsqueeze(1)).squeeze(1).numpy()
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
