"""Baselines for room types: naive Bayes and the most common type."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import product
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import one_hot

from training.datasets.batches import SceneTensors
from training.evaluation.baselines import Lists, training_lists
from training.evaluation.selection import Proposals
from training.evaluation.setting import Parameters, RoomScore, Structure, with_room_type

# Naive Bayes over room types:
#
#     log p(t | v) = log p(t) + s · sum_j log p(v_j | t) + constant
#     p(v_j = 1 | t) = (scenes of t with j + α · p(j)) / (scenes of t + α)
#
# The sum runs over the listed classes, or over all classes. Classes that often occur together are
# no independent evidence. A factor s < 1 corrects for this. If the request names its data source,
# all counts are those of this source alone, with another α.

_ALPHA = (10.0, 30.0, 100.0, 300.0)
_SOURCE_ALPHA = (1.0, 3.0, 10.0)
_EXPONENTS = (0.5, 0.75)


class _Counts(NamedTuple):
    """Weighted counts of the scenes of each room type: all, with a class, and labelled."""

    scenes: Float[Tensor, " C"]
    present: Float[Tensor, "C V"]
    labelled: Float[Tensor, "C V"]

    @classmethod
    def of(cls, lists: Lists, room: Int[Tensor, " scenes"], types: int) -> _Counts:
        """Count lists whose scenes have these room types."""
        member = one_hot(room, types).float().T * lists.weight
        return cls(member.sum(1), member @ lists.v, member @ lists.labelled.float())

    def table(
        self, alpha: float, exponent: float, absent: bool
    ) -> tuple[Float[Tensor, " C"], Float[Tensor, "C V"]]:
        """Return the bias of each room type and the weights of the classes."""
        average = (self.present.sum(0) + 0.5) / (self.labelled.sum(0) + 1.0)
        p = (self.present + alpha * average) / (self.labelled + alpha)
        prior = ((self.scenes + 0.5) / (self.scenes + 0.5).sum()).log()
        without = torch.log1p(-p) * absent
        return prior + exponent * without.sum(1), exponent * (p.log() - without)


def room_table(tables: Mapping[str, tuple[Tensor, Tensor]]) -> RoomScore:
    """Return the log p of linear scores for each data source; "" stands for all data sources."""

    def score(v: Float[Tensor, "B V"], profile: str) -> Float[Tensor, "B C"]:
        bias, weights = tables.get(profile, tables[""])
        return (bias + v @ weights.T).log_softmax(1)

    return score


def _counts(train: SceneTensors, structure: Structure) -> Iterator[tuple[str, dict[str, _Counts]]]:
    """Yield each set of scenes with its counts for all data sources, and for each data source."""
    scenes = with_room_type(train)
    if not len(scenes):
        raise ValueError("no training scene has a room type")
    types = int(scenes.room.max()) + 1
    for name, lists in training_lists(scenes, structure):
        room, source = scenes.room[lists.index], scenes.source[lists.index]
        counts = {"": _Counts.of(lists, room, types)}
        for k in source.unique().tolist():
            part = Lists(*(values[source == k] for values in vars(lists).values()))
            counts[scenes.source_names[k]] = _Counts.of(part, room[source == k], types)
        yield name, counts


def naive_bayes(train: SceneTensors, structure: Structure, _seed: int) -> Proposals[RoomScore]:
    """Yield a score for each set of scenes, smoothing, kind of evidence and exponent."""
    grid = tuple(product(_ALPHA, _SOURCE_ALPHA, (False, True), _EXPONENTS))
    for name, counts in _counts(train, structure):
        for alpha, source_alpha, absent, s in grid:
            tables = {
                source: count.table(source_alpha if source else alpha, s, absent)
                for source, count in counts.items()
            }
            kind: Parameters = {"scenes": name, "absent": absent, "exponent": s}
            yield {**kind, "alpha": alpha, "source_alpha": source_alpha}, room_table(tables)


def most_common(train: SceneTensors, structure: Structure, _seed: int) -> Proposals[RoomScore]:
    """Yield the frequencies of the room types for each set of scenes."""
    for name, counts in _counts(train, structure):
        yield {"scenes": name}, room_table({q: c.table(1.0, 0.0, False) for q, c in counts.items()})
