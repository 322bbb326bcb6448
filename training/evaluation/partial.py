"""T2 partial: a share of a scene's classes is shown; are the hidden ones proposed?

Of each scene, 25, 50 or 75 % of the classes are shown (rounded; at least one is shown and one
hidden), or all but one. The order in which classes are hidden depends on the scene and the seed
alone, and what is shown at 25 % is shown at 50 % too. Structure is always shown and never counted.
A model answers with its default coverage, and once more with every unlisted class absent.

Every hidden class is ranked among the absent classes that are not hidden themselves (filtered
ranking): another hidden class above it is right, not wrong. Precision@5 is the share of the first
five absent classes that are hidden; where fewer are hidden, it cannot reach 1. Ties score their
expectation under random order. Scenes under two classes are skipped.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from app.registry import Artifact
from training.batches import SceneTensors
from training.evaluation.asking import missing_probabilities, of_classes
from training.evaluation.cases import scene_rng
from training.evaluation.contenders import Contender
from training.evaluation.intervals import Metric
from training.evaluation.metrics import Ratio
from training.evaluation.missing import ObjectScore, Probe, rank_blocks
from training.evaluation.relations import expected_hits
from training.evaluation.setting import Outcome, Setting

SHARES: dict[str, float | None] = {
    "50 %": 0.5,
    "25 %": 0.25,
    "75 %": 0.75,
    "all but one": None,
}
"""What is shown of a scene, the primary one first."""

_FIRST = 5
_BLOCK = 256
# Unlisted is absent: every object that is there was listed.
_CLOSED = 1.0


@dataclass(frozen=True, eq=False)
class Partial:
    """Scenes of which a part is hidden.

    Attributes:
        scene: (N,) position of the scene in the set.
        v: (N, V) presence of what is shown; hidden: (N, V) bool.
        scenes: how many were given.
    """

    scene: Tensor
    v: Tensor
    hidden: Tensor
    scenes: int


@dataclass(frozen=True, eq=False)
class PartialRanking:
    """Reciprocal ranks, and hits among the first five.

    Attributes:
        mrr: over hidden classes.
        precision: over scenes.
    """

    mrr: Ratio
    precision: Ratio


def hide(scenes: SceneTensors, structure: Tensor, share: float | None, seed: int = 0) -> Partial:
    """Hide classes of every scene that has two.

    Args:
        structure: (V,) bool.
        share: of the classes that is shown; all but one for None.
    """
    plain = ~structure.numpy()
    places: list[int] = []
    hidden = torch.zeros_like(scenes.v, dtype=torch.bool)
    for k, scene in enumerate(scenes.scenes):
        classes = scene.evidence.classes[plain[scene.evidence.classes]]
        if len(classes) < 2:
            continue
        order = scene_rng(scene, seed).permutation(classes)
        hidden[k, torch.from_numpy(order[shown_classes(len(order), share) :])] = True
        places.append(k)
    index = torch.tensor(places, dtype=torch.int64)
    v = scenes.v.masked_fill(hidden, 0.0)
    return Partial(index, v[index], hidden[index], len(scenes))


def shown_classes(classes: int, share: float | None) -> int:
    """How many of so many classes are shown; at least one is, and one is hidden."""
    if share is None:
        return classes - 1
    return min(max(int(share * classes + 0.5), 1), classes - 1)


@torch.no_grad()
def rank_hidden(partial: Partial, structure: Tensor, score: ObjectScore) -> PartialRanking:
    """Rank what is hidden.

    Raises:
        LeakError: the score depends on more than what is shown.
        FloatingPointError: a score is nan.
        ValueError: no scene has two classes.
    """
    if not len(partial.v):
        raise ValueError("no scene has two classes, one to show and one to hide")
    values = _scores(partial, structure, score)
    blocks = _blocks(partial, values)
    ranking = rank_blocks(blocks, partial.scenes, skipped=partial.scenes - len(partial.scene))
    hits = np.zeros(partial.scenes)
    for k, own, truth in zip(partial.scene.tolist(), values, partial.hidden, strict=True):
        candidate = own > -torch.inf
        found, right = own[candidate].double().numpy(), truth[candidate].numpy()
        hits[k] = expected_hits(found, right, _FIRST)
    asked = np.bincount(partial.scene.numpy(), minlength=partial.scenes)
    return PartialRanking(
        mrr=ranking.ratio(ranking.reciprocal_rank()),
        precision=Ratio(hits, _FIRST * asked.astype(np.float64)),
    )


def _scores(partial: Partial, structure: Tensor, score: ObjectScore) -> Tensor:
    """(N, V), -inf but for candidates."""
    probe = Probe(len(partial.v))
    room = torch.full((len(partial.v),), -1, dtype=torch.int64)
    found = []
    for start in range(0, len(partial.v), _BLOCK):
        v = partial.v[start : start + _BLOCK]
        values = score(v)
        probe.watch(start, v, room[start : start + _BLOCK], values)
        # The least a candidate can have: what was given no probability at all stays a candidate.
        lowest = torch.finfo(values.dtype).min
        shown = (v > 0) | structure
        found.append(values.clamp(min=lowest).masked_fill(shown, -torch.inf))
    probe.ask_again(lambda v, _: score(v))
    return torch.cat(found)


def _blocks(partial: Partial, values: Tensor) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """One block a scene: its hidden classes, each without the other ones."""
    for k, own, hidden in zip(partial.scene, values, partial.hidden, strict=True):
        targets = hidden.nonzero().squeeze(1)
        others = hidden & ~torch.eye(len(own), dtype=torch.bool)[targets]
        rows = own.expand(len(targets), -1).masked_fill(others, -torch.inf)
        yield k.expand(len(targets)), targets, rows


def partial_score(artifact: Artifact, coverage: float | None = None) -> ObjectScore:
    """Log-probabilities of `/missing`, asked with the labels alone.

    Args:
        coverage: the model's default for None; 1 for unlisted = absent.
    """

    def score(v: Tensor) -> Tensor:
        return torch.from_numpy(np.stack([_log_p(artifact, row, coverage) for row in v.numpy()]))

    return score


def _log_p(
    artifact: Artifact, row: NDArray[np.float32], coverage: float | None
) -> NDArray[np.float64]:
    p = missing_probabilities(artifact, of_classes(np.flatnonzero(row).tolist()), coverage)
    log_p: NDArray[np.float64] = np.log(np.maximum(p, np.finfo(np.float64).tiny))
    return log_p


def partial_task(contender: Contender, setting: Setting) -> Outcome | None:
    """T2 partial; a published model stands beside itself with unlisted = absent."""
    artifact = contender.artifact
    score = contender.objects if artifact is None else partial_score(artifact)
    if score is None:
        return None
    scenes = setting.some()
    metrics: dict[str, Metric] = {}
    skipped = 0
    for name, share in SHARES.items():
        cases = hide(scenes, setting.structure, share, setting.seed)
        if not len(cases.scene):
            return None
        skipped = len(scenes) - len(cases.scene)
        found = rank_hidden(cases, setting.structure, score)
        metrics |= {f"MRR, {name}": found.mrr, f"precision@5, {name}": found.precision}
        if artifact is not None:
            closed = rank_hidden(cases, setting.structure, partial_score(artifact, _CLOSED))
            metrics |= {
                f"MRR, {name}, unlisted absent": closed.mrr,
                f"change of MRR, {name}": difference(found.mrr, closed.mrr),
                f"change of precision@5, {name}": difference(found.precision, closed.precision),
            }
    return Outcome(metrics, len(scenes), skipped)


def difference(a: Ratio, b: Ratio) -> Ratio:
    """a minus b of the same items, as a metric with its paired interval.

    Raises:
        ValueError: they are of other items.
    """
    if not np.array_equal(a.denominators, b.denominators):
        raise ValueError("the two were measured on different items")
    return Ratio(a.numerators - b.numerators, a.denominators)
