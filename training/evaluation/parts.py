"""Random parts of scenes, as a robot lists them, and the rank of the hidden classes.

A part lists some classes of a scene and hides the others. Structure classes are neither listed nor
hidden, nor candidates. Classes of one family with a listed class are neither targets nor
candidates, because the service never proposes them. The rank of a hidden class ignores the other
hidden classes, so these never count as errors. For ties, a metric is the expectation under random
order. The random choices for a scene depend only on the seed and the id of the scene.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from app.inference.weights import LISTED_SHARES
from app.scene import Scene, SceneObject
from training.datasets.array_types import Rng
from training.datasets.batches import SceneTensors, subset
from training.datasets.cases import scene_rng, some_scenes
from training.evaluation.metrics import Ratio
from training.evaluation.setting import Structure, by_source

REAL_SOURCES: Final = ("sunrgbd", "3dssg", "sunrgbd_bedrooms_3d", "matterport_rooms")
"""Data sources of real rooms with nearly complete object lists."""

ALL_BUT_ONE: Final = len(LISTED_SHARES)
"""Bin of the listed share, and row of kappa, for lists of all classes but one."""

LONGEST: Final = 12  # maximum number of listed classes of a random part in `validation_score`
_SCENES = 400  # maximum scenes of each source in `validation_score`
_BLOCK = 256

Size: TypeAlias = Callable[[int, Rng], int]
"""Function of the number of classes of a scene. It returns the number to list, 0 for no part."""

ListScore: TypeAlias = Callable[[Float[Tensor, "B V"], Int[Tensor, " B"]], Float[Tensor, "B V"]]
"""Function from lists and their share bins to scores."""


@dataclass(frozen=True, eq=False)
class Parts:
    """N parts of scenes."""

    scene: Int[Tensor, " N"]
    v: Float[Tensor, "N V"]  # 1 for listed classes
    hidden: Bool[Tensor, "N V"]
    related: Bool[Tensor, "N V"]  # unlisted classes of one family with a listed class
    scenes: int  # number of scenes of the set, with the scenes without a part

    @property
    def skipped(self) -> int:
        """Number of scenes without a part."""
        return self.scenes - len(self.scene.unique())


def all_but_one(classes: int, _: Rng) -> int:
    """List all classes but one."""
    return classes - 1


def share_of(share: float) -> Size:
    """List a share of the classes, at least one; at least one is hidden."""
    return lambda classes, _: min(max(round(share * classes), 1), classes - 1)


def one_quarter(classes: int, _: Rng) -> int:
    """List 25 % of the classes, at least one; at least one is hidden."""
    return min(max(int(0.25 * classes + 0.5), 1), classes - 1)


def exactly(number: int) -> Size:
    """List `number` classes of scenes with more classes."""
    return lambda classes, _: number if classes > number else 0


def up_to_longest(classes: int, rng: Rng) -> int:
    """List a random number of classes, from one to `LONGEST`; at least one is hidden."""
    most = min(LONGEST, classes - 1)
    return int(rng.integers(1, most + 1)) if most > 0 else 0


def draw_parts(
    scenes: SceneTensors, structure: Structure, size: Size, seeds: Sequence[int] = (0,)
) -> Parts:
    """Draw a part of each scene for each seed."""
    is_thing = ~structure.numpy()
    rows: list[int] = []
    hidden: list[Int[NDArray, " hidden"]] = []
    for seed in seeds:
        for k, scene in enumerate(scenes.scenes):
            rng = scene_rng(scene, seed)
            order = rng.permutation(scene.evidence.classes[is_thing[scene.evidence.classes]])
            if listed := size(len(order), rng) if len(order) else 0:
                rows.append(k)
                hidden.append(order[listed:])
    index = torch.tensor(rows, dtype=torch.int64)
    mask = torch.zeros(len(rows), len(is_thing), dtype=torch.bool)
    for row, classes in enumerate(hidden):
        mask[row, torch.from_numpy(classes)] = True
    v = scenes.v[index].masked_fill(mask | structure, 0.0)
    return Parts(index, v, mask, scenes.relatives_of(v) & (v == 0), len(scenes))


def of_classes(classes: Sequence[int]) -> Scene:
    """Return a scene with one object for each entry of `classes`."""
    return Scene(tuple(SceneObject(str(k), str(c), c) for k, c in enumerate(classes)))


def share_bin(listed: Float[Tensor, " B"], classes: Float[Tensor, " B"]) -> Int[Tensor, " B"]:
    """Return the bin of `LISTED_SHARES` for lists of so many of the classes of a scene."""
    bins = torch.bucketize(listed / classes, torch.tensor(LISTED_SHARES[:-1]))
    return torch.where(listed >= classes - 1, ALL_BUT_ONE, bins)


@dataclass(frozen=True, eq=False)
class Ranking:
    """Ranks of all hidden classes of a set of scenes."""

    scene: Int[NDArray, " N"]
    target: Int[NDArray, " N"]  # hidden class
    above: Int[NDArray, " N"]  # number of candidates with a higher score
    ties: Int[NDArray, " N"]  # number of other candidates with the same score
    scenes: int

    @classmethod
    def of(
        cls,
        scene: Int[Tensor, " N"],
        target: Int[Tensor, " N"],
        values: Float[Tensor, "N V"],
        scenes: int,
    ) -> Ranking:
        """Compute ranks from scores; classes that are not candidates have score -inf.

        Raises:
            FloatingPointError: a score is NaN.
        """
        if bool(values.isnan().any()):
            raise FloatingPointError("the score of a class is NaN")
        target_score = values.gather(1, target.unsqueeze(1))
        above, ties = (values > target_score).sum(1), (values == target_score).sum(1) - 1
        return cls(scene.numpy(), target.numpy(), above.numpy(), ties.numpy(), scenes)

    def mrr(self, selection: Bool[NDArray, " N"] | slice = slice(None)) -> Ratio:
        """Return the mean of 1 / rank of the selected targets, expected over ties."""
        # Mean of 1/r over r = above + 1 .. above + ties + 1, by harmonic numbers.
        last = self.above + self.ties + 1
        ranks = np.arange(1, int(last.max(initial=1)) + 1)
        harmonic = np.concatenate([[0.0], np.cumsum(1.0 / ranks)])
        values = (harmonic[last] - harmonic[self.above]) / (self.ties + 1)
        return Ratio.of_items(self.scene[selection], values[selection], self.scenes)

    def top(self, k: int) -> Ratio:
        """Return the share of targets among the first k candidates."""
        share = np.clip((k - self.above) / (self.ties + 1), 0.0, 1.0)
        return Ratio.of_items(self.scene, share, self.scenes)


def rank_hidden(parts: Parts, structure: Structure, values: Float[Tensor, "N V"]) -> Ranking:
    """Rank each hidden class among the unlisted classes, by scores.

    Classes of one family with a listed class are neither ranked nor candidates.
    """
    # -inf marks classes that are no candidates. So a candidate of score -inf gets the smallest
    # finite score.
    values = values.clamp(min=torch.finfo(values.dtype).min)
    values = values.masked_fill((parts.v > 0) | structure | parts.related, -torch.inf)
    row, target = (parts.hidden & ~parts.related).nonzero(as_tuple=True)
    others = parts.hidden[row].scatter(1, target.unsqueeze(1), False)  # other hidden classes
    competing = values[row].masked_fill(others, -torch.inf)
    return Ranking.of(parts.scene[row], target, competing, parts.scenes)


def real_sources(scenes: SceneTensors) -> Iterator[tuple[str, SceneTensors]]:
    """Generate `REAL_SOURCES` by name, with their scenes; all sources if there are no real ones."""
    every = dict(by_source(scenes))
    for name in [x for x in REAL_SOURCES if x in every] or every:
        yield name, every[name]


@torch.no_grad()
def validation_score(
    score_function: ListScore, scenes: SceneTensors, structure: Structure
) -> float:
    """Return the mean over real sources of the MRR of hidden classes; NaN without hidden classes.

    The MRR of a source is the mean of two MRRs: of random parts of 1 to `LONGEST` classes, and of
    parts of all classes but one. At most 400 scenes of each source take part. Scenes with
    incomplete object lists are left out, unless all lists are incomplete. If the scenes contain no
    source of `REAL_SOURCES`, all sources count.

    Raises:
        FloatingPointError: a score is NaN.
    """
    values = []
    some = scenes.complete if bool(scenes.complete.any()) else ~scenes.complete
    for _, own in real_sources(subset(scenes, some)):
        sample = some_scenes(own, _SCENES)
        for size in (up_to_longest, all_but_one):
            parts = draw_parts(sample, structure, size)
            if not len(parts.v):
                continue
            listed = parts.v.sum(1)
            bins = share_bin(listed, listed + parts.hidden.sum(1))
            blocks = zip(parts.v.split(_BLOCK), bins.split(_BLOCK), strict=True)
            scores = torch.cat([score_function(v, block) for v, block in blocks])
            values.append(rank_hidden(parts, structure, scores).mrr().value)
    return float(np.mean(values)) if values else float("nan")
