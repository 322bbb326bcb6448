"""T2: one class left out with all its instances and relations, ranked among all absent classes.

Every relation is unobserved, so nothing of the removed object can leak. Ties score their
expectation under random order. Structure classes are neither removed nor candidates; scenes with
fewer than two other classes are skipped. A mention outside the vocabulary would score 0
(`with_unknown`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from training.batches import SceneTensors
from training.evaluation.intervals import Figure
from training.evaluation.metrics import Macro, Ratio
from training.machines import BoltzmannMachine
from training.machines.log_odds import object_log_odds
from training.machines.mean_field import Evidence

# Log-odds (B, V) of every class given presence (B, V).
ObjectScore = Callable[[Tensor], Tensor]
# The same given room types (B,) as well, -1 where none is known.
RoomScore = Callable[[Tensor, Tensor], Tensor]

_PROBED = 64

TOP = (1, 2, 3, 5, 10, 20, 50)
"""Lengths of the lists in which a removed object is looked for."""


class LeakError(ValueError):
    """A score knows more than it was shown."""


@dataclass(frozen=True)
class LeaveOneOut:
    """Every removed object of a set of scenes.

    Attributes:
        scene: (N,) position of the scene in the set.
        target: (N,) the removed class.
        above: (N,) classes ranked above the target; ties: (N,) others with exactly its score.
        log_probability: (N,) of the target under a softmax over absent candidates.
        scenes, skipped: how many scenes were given, and how many had too few classes.
    """

    scene: NDArray[np.int64]
    target: NDArray[np.int64]
    above: NDArray[np.int64]
    ties: NDArray[np.int64]
    log_probability: NDArray[np.float64]
    scenes: int
    skipped: int

    def reciprocal_rank(self) -> NDArray[np.float64]:
        """Expectation of 1 / rank under random order of ties, (N,)."""
        # Mean of 1/r over r = above + 1 .. above + ties + 1, by harmonic numbers.
        harmonic = np.concatenate([[0.0], np.cumsum(1.0 / np.arange(1, self._length() + 1))])
        last = self.above + self.ties + 1
        return (harmonic[last] - harmonic[self.above]) / (self.ties + 1)

    def top(self, k: int) -> NDArray[np.float64]:
        """Probability that the target is among the first k, (N,)."""
        return np.clip((k - self.above) / (self.ties + 1), 0.0, 1.0)

    def _length(self) -> int:
        return int((self.above + self.ties).max(initial=0)) + 1

    def ratio(self, values: NDArray[np.float64]) -> Ratio:
        """Mean of per-object values, (N,)."""
        return Ratio.of_items(self.scene, values, self.scenes)

    def figure(self, values: NDArray[np.float64]) -> Figure:
        """The same with its interval."""
        return self.ratio(values).figure()

    def macro(self, values: NDArray[np.float64]) -> Macro:
        """Mean over the removed classes of their mean value: rare ones count as frequent ones."""
        return Macro(self.scene, self.target, values, self.scenes)

    def with_unknown(self, unknown: NDArray[np.int64]) -> Ratio:
        """MRR where labels outside the vocabulary count as removed objects that score 0.

        Args:
            unknown: (scenes,) such labels of each scene; skipped scenes stay skipped.
        """
        known = self.ratio(self.reciprocal_rank())
        scored = known.denominators > 0
        return Ratio(known.numerators, known.denominators + unknown * scored)


@dataclass(frozen=True, eq=False)
class MachineScore:
    """Log-odds under a machine with every relation unobserved.

    Seed-form machines sum relations out at the mean-field fixed point.
    """

    machine: BoltzmannMachine

    def __call__(self, v: Tensor, room: Tensor | None = None) -> Tensor:
        """Scores (B, V) of presence (B, V), room types (B,) withheld unless they are given."""
        evidence = Evidence(v, self.machine.acting_units(v), room=room)
        return object_log_odds(self.machine, evidence)


def machine_score(machine: BoltzmannMachine) -> MachineScore:
    """A machine's score; it takes room types too."""
    return MachineScore(machine)


def removed_objects(
    scenes: SceneTensors, structure: Tensor, score: ObjectScore, *, block: int = 256
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Remove every non-structure class of every scene in turn, block by block.

    Args:
        structure: (V,) bool.
        score: log-odds of all classes, higher = likelier missing.

    Yields:
        Positions of the scenes (n,), the removed classes (n,), and the scores (n, V), -inf but for
        candidates.
    """
    return _removed(scenes, structure, lambda v, _: score(v), block)


@torch.no_grad()
def _removed(
    scenes: SceneTensors, structure: Tensor, score: RoomScore, block: int = 256
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    removable = (scenes.v > 0) & ~structure
    enough = removable.sum(1) >= 2
    row, target = (removable & enough.unsqueeze(1)).nonzero(as_tuple=True)
    probe = Probe(len(row))
    for start in range(0, len(row), block):
        r, t = row[start : start + block], target[start : start + block]
        v = scenes.v[r].scatter(1, t.unsqueeze(1), 0.0)
        room = scenes.room[r]
        values = score(v, room)
        probe.watch(start, v, room, values)
        yield r, t, values.masked_fill((v > 0) | structure, -torch.inf)
    probe.ask_again(score)


class Probe:
    """Rows of all blocks, shown once more in another order and company.

    Who knows whose turn it is, by counting or by relations that dangle where an object was, answers
    otherwise then. (Who recognises a scene by the objects that are left has seen it before: against
    that stand the splits by group.)
    """

    def __init__(self, rows: int) -> None:
        order = np.random.default_rng(0).permutation(rows)[:_PROBED]
        self._rows = torch.from_numpy(order)
        self._shown: dict[int, tuple[Tensor, Tensor, Tensor]] = {}

    def watch(self, start: int, v: Tensor, room: Tensor, values: Tensor) -> None:
        """Keep what was answered to chosen rows of the block that begins at `start`."""
        here = (self._rows >= start) & (self._rows < start + len(v))
        for k in self._rows[here].tolist():
            self._shown[k] = (v[k - start], room[k - start], values[k - start])

    def ask_again(self, score: RoomScore) -> None:
        """Ask for these rows alone.

        Raises:
            LeakError: an answer has changed.
        """
        if not self._shown:
            return
        shown = [self._shown[k] for k in self._rows.tolist()]
        v, room, values = (torch.stack(column) for column in zip(*shown, strict=True))
        if not torch.allclose(score(v, room), values, rtol=1e-3, atol=1e-3, equal_nan=True):
            raise LeakError("the same scenes in another order get other scores: something leaks")


def leave_one_out(scenes: SceneTensors, structure: Tensor, score: ObjectScore) -> LeaveOneOut:
    """Rank every removed object; see `removed_objects`.

    Raises:
        LeakError: the score depends on more than the objects that are left.
    """
    return leave_one_out_in_rooms(scenes, structure, lambda v, _: score(v))


def leave_one_out_in_rooms(
    scenes: SceneTensors, structure: Tensor, score: RoomScore
) -> LeaveOneOut:
    """The same where the score is told the room type of each scene."""
    enough = ((scenes.v > 0) & ~structure).sum(1) >= 2
    blocks = _removed(scenes, structure, score)
    return rank_blocks(blocks, len(scenes), skipped=int((~enough).sum()))


def rank_blocks(
    blocks: Iterable[tuple[Tensor, Tensor, Tensor]], scenes: int, skipped: int
) -> LeaveOneOut:
    """Rank targets by scores, blocks as `removed_objects` yields them.

    Raises:
        FloatingPointError: a score is nan.
    """
    empty = torch.zeros(0, dtype=torch.int64)
    rows, targets, above, ties = [empty], [empty], [empty], [empty]
    log_p = [torch.zeros(0, dtype=torch.float64)]
    for row, target, values in blocks:
        if bool(values.isnan().any()):
            raise FloatingPointError("a score is not a number")
        chosen = values.gather(1, target.unsqueeze(1))
        rows.append(row)
        targets.append(target)
        above.append((values > chosen).sum(1))
        ties.append((values == chosen).sum(1) - 1)
        log_p.append((chosen.squeeze(1) - values.logsumexp(1)).double())
    return LeaveOneOut(
        scene=torch.cat(rows).numpy(),
        target=torch.cat(targets).numpy(),
        above=torch.cat(above).numpy(),
        ties=torch.cat(ties).numpy(),
        log_probability=torch.cat(log_p).numpy(),
        scenes=scenes,
        skipped=skipped,
    )


def missing_metrics(result: LeaveOneOut) -> dict[str, Ratio | Macro]:
    """MRR and top-k, micro-averaged over removed objects, and MRR by class."""
    reciprocal = result.reciprocal_rank()
    metrics: dict[str, Ratio | Macro] = {"MRR": result.ratio(reciprocal)}
    for k in TOP:
        metrics[f"top-{k}"] = result.ratio(result.top(k))
    return metrics | {"MRR, macro by class": result.macro(reciprocal)}
