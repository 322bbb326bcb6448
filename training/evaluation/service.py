"""The tasks asked through a running service, and the same figures without it.

Scenes are posted as their distinct classes, one instance each, and everything that comes back is
ranked. Beside it stands the model itself under the harness's scores, brought to the probabilities
that are published: the two may differ by rounding alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import httpx
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from app.reasoning.calibration import (
    exclusive,
    false_log_odds,
    relation_probability,
    sigmoid,
)
from app.registry import Artifact
from app.registry.slopes import RelationSlopes
from app.scene import CANONICAL, OPPOSITES
from training.batches import Batch, SceneTensors
from training.datasets import EncodedScene
from training.evaluation.alarms import calibrated_alarm
from training.evaluation.completion import complete_scenes
from training.evaluation.intervals import Metric
from training.evaluation.missing import leave_one_out, machine_score
from training.evaluation.outliers import IntruderScores, draw_intruders, intruder_scores
from training.evaluation.placed import PlacedScore, Places, leave_one_out_at
from training.evaluation.placement import placement_scores
from training.evaluation.relations import RelationScore, candidates, rank, score_scenes
from training.evaluation.scores import machine_scores, served_placed_score
from training.machines.arrays import machine_of
from training.oracle.units import NO_UNIT
from training.trainer import subset

# The most relations that one request returns, and its most pairs.
_MOST = 4096


class ServiceError(RuntimeError):
    """The service did not answer a question; says which problem it named."""


@dataclass(frozen=True, eq=False)
class Asked:
    """One model, whichever way it is asked.

    Attributes:
        objects: log-odds (B, V) of the absent classes of presence (B, V).
        relations: probabilities (B, A, n, n) given the observed relations of a batch.
        stated: the same for the relations that a batch states: the higher, the likelier true.
        placed: scores of what is missing at a place.
        intruders: T3's scores of some scenes, and by its side which of them raise the alarm.
    """

    objects: Callable[[Tensor], Tensor]
    relations: RelationScore
    stated: RelationScore
    placed: PlacedScore
    intruders: Callable[[SceneTensors, Tensor, int], tuple[IntruderScores, NDArray[np.bool_]]]


def metrics(
    asked: Asked, scenes: SceneTensors, structure: Tensor, seed: int = 0
) -> dict[str, Metric]:
    """T1a, T1b, T2, T2-at, T3 and T3b; those for which the scenes hold something.

    T1b and T3b state relations. Where several instances of two classes stand both ways round, one
    instance each cannot: such scenes are left out of these.
    """
    found: dict[str, Metric] = {}
    size = len(scenes)
    one_way = [k for k, scene in enumerate(scenes.scenes) if not _both_ways(scene, structure)]
    consistent = subset(scenes, torch.tensor(one_way, dtype=torch.int64))
    plain = candidates(score_scenes(scenes, asked.relations), structure)
    if any(scene.truth.any() for scene in plain):
        found["T1a R-precision"] = rank(plain, size).pooled()
    half = complete_scenes(consistent, structure, asked.relations, seed=seed)
    if any(scene.truth.any() for scene in half):
        found["T1b R-precision"] = rank(half, len(consistent)).pooled()
    missing = leave_one_out(scenes, structure, asked.objects)
    if len(missing.target):
        found["T2 MRR"] = missing.ratio(missing.reciprocal_rank())
        found["T2 top-10"] = missing.ratio(missing.top(10))
    placed = leave_one_out_at(scenes, structure, asked.placed, seed=seed)
    if len(placed.relation):
        found["T2-at MRR"] = placed.mrr()
    outliers, loud = asked.intruders(scenes, structure, seed)
    if len(outliers.scene):
        found["T3 hit@1"] = outliers.hit_at_1()
        found["T3 AUROC"] = outliers.auroc()
        found["T3 alarms"] = outliers.false_alarms(loud)
    false = placement_scores(consistent, structure, asked.stated, seed=seed)
    if len(false.scene):
        found["T3b hit@1"] = false.hit_at_1()
    return found


def _both_ways(scene: EncodedScene, structure: Tensor) -> bool:
    """Some a(x, y) and a(y, x) hold between two classes that are asked about."""
    holds, classes = scene.evidence.holds, scene.evidence.classes
    plain = ~structure.numpy()[classes]
    asked = plain[:, None] & plain & ~np.eye(len(classes), dtype=np.bool_)
    return bool((holds & holds.swapaxes(1, 2) & asked).any())


def directly(artifact: Artifact) -> Asked:
    """The model under the harness's scores, without a service.

    Raises:
        ServiceError: it is of the seed form, where the two are different estimates.
    """
    machine, calibration = machine_of(artifact.weights), artifact.calibration
    if machine.spec.form != "local":
        raise ServiceError("in the seed form the service draws contexts, the scores do not")
    objects, scores = machine_score(machine), machine_scores(machine)
    at_place = served_placed_score(artifact)

    def log_odds(batch: Batch) -> Tensor:
        values = scores.completion(replace(batch, counts=(batch.classes >= 0).long()))
        # What has no unit is never, to a service too.
        return values.clamp(min=NO_UNIT)

    def relations(batch: Batch) -> Tensor:
        values = log_odds(batch).numpy()
        pairs = np.zeros(values.shape[-2:], values.dtype)
        told = (batch.observed & (batch.holds > 0)).flatten(1).any(1).tolist()
        sizes = (batch.classes >= 0).sum(1).tolist()
        slopes = RelationSlopes.of(calibration)
        rows = [
            relation_probability(slopes.given if given else slopes.alone, value[None], pairs, size)[
                0
            ]
            for value, given, size in zip(values, told, sizes, strict=True)
        ]
        p = np.stack(rows)
        return torch.from_numpy(exclusive(p, p.swapaxes(-1, -2))[0])

    def stated(batch: Batch) -> Tensor:
        return -torch.from_numpy(sigmoid(false_log_odds(calibration, log_odds(batch).numpy())))

    def placed(places: Places) -> Tensor:
        return at_place(replace(places, counts=places.v)).double().sigmoid()

    def intruders(
        scenes: SceneTensors, structure: Tensor, seed: int
    ) -> tuple[IntruderScores, NDArray[np.bool_]]:
        found = intruder_scores(scenes, structure, objects, seed=seed)
        return found, calibrated_alarm(calibration).raised(found)

    return Asked(objects, relations, stated, placed, intruders)


def over_http(client: httpx.Client, model: str, artifact: Artifact) -> Asked:
    """The model as a service answers for it.

    Args:
        client: whose base address is the service's.
        model: as requests name it.
        artifact: the same model, for its labels.

    What is asked raises `ServiceError` where the service refuses, or answers with another model.
    """
    service = _Service(client, model, artifact)
    return Asked(
        service.objects, service.relations, service.stated, service.placed, service.intruders
    )


@dataclass(frozen=True, eq=False)
class _Service:
    client: httpx.Client
    model: str
    artifact: Artifact

    def objects(self, v: Tensor) -> Tensor:
        # Full coverage: the harness counts unlisted classes as absent.
        rows = [self._missing(row, "log_odds", coverage=1.0) for row in v]
        return torch.stack(rows)

    def placed(self, places: Places) -> Tensor:
        rows = []
        for row, v in enumerate(places.v):
            name = CANONICAL[int(places.relation[row])]
            anchor = self.artifact.vocabulary.labels[int(places.anchor[row])]
            # The place is told from the missing thing's side.
            name = name if places.outgoing[row] else OPPOSITES[name]
            rows.append(self._missing(v, "probability", at={"relation": name, "object": anchor}))
        return torch.stack(rows)

    def relations(self, batch: Batch) -> Tensor:
        found = torch.full(batch.holds.shape, -torch.inf, dtype=torch.float64)
        for row, own in enumerate(batch.classes):
            labels = self._labels(own[own >= 0])
            place = {label: k for k, label in enumerate(labels)}
            pairs = [(x, y) for x in labels for y in labels if x != y]
            most = _MOST // len(CANONICAL)
            for start in range(0, len(pairs), most):
                body = {
                    "objects": labels,
                    "relations": self._stated(batch, row, labels),
                    "pairs": [{"subject": x, "object": y} for x, y in pairs[start : start + most]],
                    "top_k": _MOST,
                }
                for entry in self._ask("/relations", body)["relations"]:
                    x, y = place[entry["subject"]], place[entry["object"]]
                    a = CANONICAL.index(entry["relation"])
                    found[row, a, x, y] = entry["probability"]
        return found

    def stated(self, batch: Batch) -> Tensor:
        found = torch.full(batch.holds.shape, -torch.inf, dtype=torch.float64)
        for row, own in enumerate(batch.classes):
            labels = self._labels(own[own >= 0])
            place = {label: k for k, label in enumerate(labels)}
            body = {"objects": labels, "relations": self._stated(batch, row, labels)}
            for entry in self._ask("/outliers", body)["misplaced"]:
                x, y = place[entry["subject"]], place[entry["object"]]
                found[row, CANONICAL.index(entry["relation"]), x, y] = -entry["probability"]
        return found

    def intruders(
        self, scenes: SceneTensors, structure: Tensor, seed: int
    ) -> tuple[IntruderScores, NDArray[np.bool_]]:
        added = draw_intruders(scenes, structure, seed=seed)
        columns: list[tuple[int, float, bool, int, bool, int, bool]] = []
        for k in (added >= 0).nonzero().squeeze(1).tolist():
            clean = scenes.v[k]
            for intruder in (-1, int(added[k])):
                classes = clean.nonzero().squeeze(1).tolist()
                classes += [intruder] * (intruder >= 0)
                labels = self._labels(torch.tensor(classes))
                of = dict(zip(labels, classes, strict=True))
                for entry in self._ask("/outliers", {"objects": labels})["outliers"]:
                    index = of[entry["object"]]
                    if not structure[index]:
                        bad = index == intruder
                        facts = (entry["log_odds"], bad, len(classes), intruder < 0)
                        columns.append((k, *facts, index, entry["is_outlier"]))
        place, log_odds, bad, sizes, untouched, things, loud = (
            zip(*columns, strict=True) if columns else [()] * 7
        )
        scores = IntruderScores(
            np.array(place, dtype=np.int64),
            np.array(log_odds, dtype=np.float64),
            np.array(bad, dtype=np.bool_),
            np.array(sizes, dtype=np.int64),
            np.array(untouched, dtype=np.bool_),
            np.array(things, dtype=np.int64),
            scenes=len(scenes),
            skipped=len(scenes) - len(set(place)),
        )
        return scores, np.array(loud, dtype=np.bool_)

    def _missing(self, v: Tensor, value: str, **options: object) -> Tensor:
        body = {"objects": self._labels(v.nonzero().squeeze(1)), "top_k": len(v), **options}
        found = torch.full(v.shape, -torch.inf, dtype=torch.float64)
        for entry in self._ask("/missing", body)["missing"]:
            found[self.artifact.vocabulary.index(entry["label"])] = entry[value]
        return found

    def _labels(self, classes: Tensor) -> list[str]:
        return [self.artifact.vocabulary.labels[index] for index in classes.tolist()]

    def _stated(self, batch: Batch, row: int, labels: Sequence[str]) -> list[dict[str, str]]:
        triples = (batch.holds[row] * batch.observed[row]).nonzero().tolist()
        return [
            {"subject": labels[x], "relation": CANONICAL[a], "object": labels[y]}
            for a, x, y in triples
        ]

    def _ask(self, path: str, body: dict[str, Any]) -> dict[str, Any]:
        try:
            answer = self.client.post(path, json={**body, "model": self.model})
        except httpx.HTTPError as error:
            raise ServiceError(f"{path} was not answered: {error}") from error
        if answer.status_code != httpx.codes.OK:
            raise ServiceError(f"{path} answered {answer.status_code}: {answer.text[:500]}")
        try:
            found: dict[str, Any] = answer.json()
            digest: str = found["model"]["digest"]
        except (ValueError, KeyError, TypeError) as error:
            raise ServiceError(f"{path} answered what is no answer of this service") from error
        if digest != self.artifact.digest:
            raise ServiceError(
                f"the service's {self.model} has digest {digest[:12]}, not "
                f"{self.artifact.digest[:12]}"
            )
        return found
