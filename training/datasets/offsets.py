"""Offsets (position differences) between related objects in scenes with poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from training.datasets import EncodedScene
from training.datasets.array_types import Flags, Floats, Ints


@dataclass(frozen=True, eq=False)
class ObservedOffsets:
    """Observed offsets between related objects, in metres and viewer axes."""

    offset: Floats  # position of the relation's subject minus that of its object, (offsets, 3)
    relation: Ints  # index of the canonical relation, (offsets,)
    subject: Ints  # class of the relation's subject, (offsets,)
    other: Ints  # class of the relation's object, (offsets,)
    scene: Ints  # index of the scene, (offsets,)
    source: Ints  # index of the data source of the scene, (offsets,)

    def rows(self, mask: Flags) -> ObservedOffsets:
        """Return the offsets where the mask, (offsets,), is True."""
        return ObservedOffsets(*(getattr(self, name)[mask] for name in self.__dataclass_fields__))


def observed_offsets(scenes: Sequence[EncodedScene]) -> ObservedOffsets:
    """Return the offsets between all related objects in all scenes with poses."""
    sources = sorted({scene.source for scene in scenes})
    offsets, rows = [np.zeros((0, 3))], [np.zeros((0, 5), dtype=np.int64)]
    for number, scene in enumerate(scenes):
        if scene.instance_positions is None:
            continue
        relation, i, j = np.nonzero(scene.instance_holds)
        offset = scene.instance_positions[i] - scene.instance_positions[j]
        finite = np.isfinite(offset).all(axis=1)
        classes = scene.instance_classes
        where = np.full(len(i), number), np.full(len(i), sources.index(scene.source))
        offsets.append(offset[finite])
        rows.append(np.stack([relation, classes[i], classes[j], *where], axis=1)[finite])
    return ObservedOffsets(np.concatenate(offsets), *np.concatenate(rows).T)
