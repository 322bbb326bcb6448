"""Models for the evaluation: a trained model, and two references for generated scenes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from app.model import SceneModel
from app.questions.misplaced import wrong_relations
from app.questions.posterior import Posterior
from app.scene import CANONICAL, OPPOSITES, RelationTable, Scene
from app.scene.relation_table import Triple
from training.datasets.batches import Batch
from training.evaluation.asking import (
    flag_outliers,
    instances_of,
    missing_log_p,
    missing_log_p_at,
    score_misplaced,
    score_missing,
    score_rooms,
    score_suspicion,
)
from training.evaluation.generation_task import (
    held_out_halves,
    independent_sampler,
    machine_sampler,
    scene_sampler,
)
from training.evaluation.model import Model, Places, Sampler
from training.evaluation.setting import Setting
from training.machines import machine_of


def artifact_model(artifact: SceneModel, *, profiles: Sequence[str] = ()) -> Model:
    """Return the answers of a trained model. Requests about rooms may name the `profiles`."""
    sampler = machine_sampler(artifact)
    judges_relations = artifact.calibration.misplaced.judges_relations
    return Model(
        missing=partial(score_missing, artifact),
        suspicion=partial(score_suspicion, artifact),
        flags=partial(flag_outliers, artifact),
        at_place=partial(score_placed, artifact),
        relations=partial(score_relations, artifact, given=False),
        completion=partial(score_relations, artifact, given=True),
        false_relations=partial(score_false_relations, artifact),
        misplaced=partial(score_misplaced, artifact) if judges_relations else None,
        rooms=partial(score_rooms, artifact, profiles) if artifact.spec.C else None,
        generate=lambda _: sampler,
        parameters=machine_of(artifact.weights).parameter_count,
        scene_model=artifact,
    )


def score_relations(artifact: SceneModel, batch: Batch, *, given: bool) -> Float[Tensor, "B A n n"]:
    """Return the log-odds of each relation between two present classes.

    With `given`, the other observed relations that hold are evidence, never the relation itself.
    """
    log_odds = torch.full(batch.holds.shape, -torch.inf)
    for row, (scene, _) in enumerate(_scenes(batch, given)):
        values = Posterior(artifact, scene).relation_log_odds()
        a, n, _ = values.shape
        log_odds[row, :a, :n, :n] = torch.from_numpy(values)
    return log_odds


def score_false_relations(artifact: SceneModel, batch: Batch) -> Float[Tensor, "B A n n"]:
    """Return the log-odds by which `/outliers` ranks observed relations; other relations: -inf."""
    log_odds = torch.full(batch.holds.shape, -torch.inf)
    for row, (scene, triples) in enumerate(_scenes(batch)):
        wrong = wrong_relations(artifact, scene)
        for triple, of_instances in triples.items():
            log_odds[(row, *triple)] = -wrong.get(of_instances, 0.0)
    return log_odds


def _scenes(batch: Batch, given: bool = True) -> Iterator[tuple[Scene, dict[Triple, Triple]]]:
    """Generate the scenes of a batch, and a map from relations of classes to those of instances.

    With `given`, a scene has the observed relations that hold. a(x, y) and a(y, x) can both hold
    between classes, but for different instances.
    """
    evidence = batch.holds * batch.observed * given
    for classes, counts, holds in zip(batch.classes, batch.counts, evidence, strict=True):
        is_class = classes >= 0
        counts = counts[is_class]
        scene, first = instances_of(classes[is_class], counts)
        observed = set(map(tuple, holds.nonzero().tolist()))
        last = first + counts.clamp(min=1) - 1
        triples: dict[Triple, Triple] = {}
        for a, x, y in sorted(observed):
            index = last if (a, y, x) in observed and x > y else first
            triples[a, x, y] = (a, int(index[x]), int(index[y]))
        table = RelationTable.stated(triples.values()) if triples else None
        yield Scene(scene.objects, table), triples


def score_placed(artifact: SceneModel, places: Places) -> Float[Tensor, "B V"]:
    """Return the log-probability of `/missing` for each class at B places; else -inf."""
    log_p = torch.empty_like(places.v)
    for row, v in enumerate(places.v):
        classes = v.nonzero().squeeze(1)
        scene, first = instances_of(classes, places.counts[row, classes])
        if places.relation[row] >= artifact.spec.A:
            # A model without this relation cannot use the place.
            log_p[row] = torch.from_numpy(missing_log_p(artifact, scene))
            continue
        relation = CANONICAL[int(places.relation[row])]
        # The request names the relation from the missing object to the anchor.
        name = relation if places.outgoing[row] else OPPOSITES[relation]
        anchor = int(first[classes == places.anchor[row]])
        log_p[row] = torch.from_numpy(missing_log_p_at(artifact, scene, name, anchor))
    return log_p


def floor_model() -> Model:
    """Return a model whose samples are held-out scenes: the best possible value of T4."""

    def sampler(setting: Setting) -> Sampler | None:
        _, second = held_out_halves(setting)
        return scene_sampler(second) if len(second) else None

    return Model(generate=sampler)


def independent_model(classes: int) -> Model:
    """Return a model that samples classes independently at their training frequencies."""
    return Model(
        generate=lambda s: None if s.train is None else independent_sampler(s.train),
        parameters=classes,
    )
