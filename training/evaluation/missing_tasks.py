"""T2: rank of objects that were hidden from a scene, in three tasks.

    T2          each class is removed in turn, with all its instances and relations
    T2 partial  25, 50 or 75 % of the classes are shown, or all but one; at least one class is shown
                and one hidden. Classes shown at 25 % are also shown at 50 %. A published model
                answers with its default coverage, and again with coverage 1 (unlisted = absent)
    T2-at       each class with a relation to another class is removed in turn. One of these
                relations, drawn at random, gives its place: the relation, its direction and the
                class at its other end

The rank of a hidden class ignores all other hidden classes, so these never count as errors.
Precision@5 is the share of hidden classes among the first five absent classes. With fewer than five
hidden classes, precision@5 cannot reach 1. For ties, a metric is the expectation under random
order.

Structure classes are never hidden and never candidates. Scenes with fewer than two other classes
are skipped. T2-at excludes relations between equal classes and relations with structure. In T2 all
relations are unobserved, because relations could reveal the removed object.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from app.registry import Artifact
from app.scene import CANONICAL
from training.datasets.array_types import Flags, Floats, Ints
from training.datasets.batches import SceneTensors
from training.datasets.cases import scene_rng
from training.evaluation.asking import ask_rows, missing_probabilities, of_classes
from training.evaluation.metrics import Macro, Metric, Ratio
from training.evaluation.model import Model, ObjectScore, PlacedScore, Places, RoomScore
from training.evaluation.relation_tasks import expected_hits
from training.evaluation.setting import Outcome, Setting
from training.machines import BoltzmannMachine
from training.machines.log_odds import object_log_odds
from training.machines.mean_field import Evidence

TOP = (1, 2, 3, 5, 10, 20, 50)
"""Values of k for top-k accuracy."""

SHARES: dict[str, float | None] = {"50 %": 0.5, "25 %": 0.25, "75 %": 0.75, "all but one": None}
"""Share of the classes that stay listed in T2 partial. None hides one class. The first share gives
the primary metric."""

_FIRST = 5
# Coverage 1: the object list is complete, so unlisted objects are absent.
_CLOSED = 1.0


@dataclass(frozen=True, eq=False)
class MachineScore:
    """The score of a machine: log-odds of each class with all relations unobserved.

    In a seed-form machine, relations affect objects. Such a machine sums the relations out at the
    mean-field fixed point.
    """

    machine: BoltzmannMachine

    @property
    def parameter_count(self) -> int:
        """Number of trained weights."""
        return self.machine.parameter_count

    def __call__(self, v: Tensor, room: Tensor | None = None) -> Tensor:
        """Return scores (B, V) for presence (B, V) and optional room types (B,)."""
        evidence = Evidence(v, self.machine.acting_units(v), room=room)
        return object_log_odds(self.machine, evidence)


@dataclass(frozen=True, eq=False)
class Ranking:
    """Ranks of all hidden classes of a set of scenes.

    Attributes:
        scene: (N,) index of the scene in the set.
        target: (N,) the hidden class.
        above: (N,) number of candidates with a higher score.
        ties: (N,) number of other candidates with the same score.
        skipped: number of scenes with too few classes.
    """

    scene: Ints
    target: Ints
    above: Ints
    ties: Ints
    scenes: int
    skipped: int

    @classmethod
    def of(
        cls, scene: Tensor, target: Tensor, values: Tensor, scenes: int, skipped: int
    ) -> Ranking:
        """Compute ranks from scores (N, V); classes that are not candidates have score -inf.

        Raises:
            FloatingPointError: a score is NaN.
        """
        if bool(values.isnan().any()):
            raise FloatingPointError("the score of a class is NaN")
        target_score = values.gather(1, target.unsqueeze(1))
        above, ties = (values > target_score).sum(1), (values == target_score).sum(1) - 1
        return cls(scene.numpy(), target.numpy(), above.numpy(), ties.numpy(), scenes, skipped)

    def reciprocal_rank(self) -> Floats:
        """Return the expectation of 1 / rank under random order of ties, (N,)."""
        # Mean of 1/r over r = above + 1 .. above + ties + 1, by harmonic numbers.
        last = self.above + self.ties + 1
        ranks = np.arange(1, int(last.max(initial=1)) + 1)
        harmonic = np.concatenate([[0.0], np.cumsum(1.0 / ranks)])
        mean: Floats = (harmonic[last] - harmonic[self.above]) / (self.ties + 1)
        return mean

    def top(self, k: int) -> Floats:
        """Return the probability that the target is among the first k, (N,)."""
        return np.clip((k - self.above) / (self.ties + 1), 0.0, 1.0)

    def mrr(self, selection: Flags | slice = slice(None)) -> Ratio:
        """Return the mean reciprocal rank of the selected targets."""
        return Ratio.of_items(self.scene[selection], self.reciprocal_rank()[selection], self.scenes)

    def metrics(self) -> dict[str, Metric]:
        """Return MRR and top-k, micro-averaged over hidden classes, and the macro MRR by class."""
        metrics: dict[str, Metric] = {"MRR": self.mrr()}
        for k in TOP:
            metrics[f"top-{k}"] = Ratio.of_items(self.scene, self.top(k), self.scenes)
        macro = Macro(self.scene, self.target, self.reciprocal_rank(), self.scenes)
        return metrics | {"MRR, macro by class": macro}

    def with_unknown(self, unknown: Ints) -> Ratio:
        """Return the MRR if each unknown label, (scenes,), is a removed object of score 0."""
        mrr = self.mrr()
        scored = mrr.denominators > 0
        return Ratio(mrr.numerators, mrr.denominators + unknown * scored)


def leave_one_out(
    scenes: SceneTensors,
    structure: Tensor,
    score: ObjectScore | RoomScore,
    *,
    with_room: bool = False,
) -> Ranking:
    """Rank each class of each scene when it is removed; `with_room` passes the room types."""
    removable = (scenes.v > 0) & ~structure
    is_usable = removable.sum(1) >= 2
    row, target = (removable & is_usable.unsqueeze(1)).nonzero(as_tuple=True)
    v = scenes.v[row].scatter(1, target.unsqueeze(1), 0.0)
    values = ask_rows(score, v, scenes.room[row]) if with_room else ask_rows(score, v)
    values = values.masked_fill((v > 0) | structure, -torch.inf)
    return Ranking.of(row, target, values, len(scenes), int((~is_usable).sum()))


@dataclass(frozen=True, eq=False)
class Partial:
    """N scenes with their index in the set (N,), shown and hidden classes (N, V)."""

    scene: Tensor
    v: Tensor
    hidden: Tensor
    scenes: int


def hide(scenes: SceneTensors, structure: Tensor, share: float | None, seed: int = 0) -> Partial:
    """Hide classes of each scene with at least two: all but a share of them, or one (None)."""
    is_thing = ~structure.numpy()
    rows: list[int] = []
    hidden = torch.zeros_like(scenes.v, dtype=torch.bool)
    for k, scene in enumerate(scenes.scenes):
        classes = scene.evidence.classes[is_thing[scene.evidence.classes]]
        if len(classes) < 2:
            continue
        order = scene_rng(scene, seed).permutation(classes)
        hidden[k, torch.from_numpy(order[shown_classes(len(order), share) :])] = True
        rows.append(k)
    index = torch.tensor(rows, dtype=torch.int64)
    v = scenes.v.masked_fill(hidden, 0.0)
    return Partial(index, v[index], hidden[index], len(scenes))


def shown_classes(classes: int, share: float | None) -> int:
    """Return the number of shown classes; at least one class is shown and one hidden."""
    if share is None:
        return classes - 1
    return min(max(int(share * classes + 0.5), 1), classes - 1)


def rank_hidden(partial: Partial, structure: Tensor, score: ObjectScore) -> tuple[Ratio, Ratio]:
    """Return (MRR over hidden classes, precision@5 over scenes).

    Raises:
        ValueError: all scenes have fewer than two classes.
    """
    if not len(partial.v):
        raise ValueError("the task T2 partial needs a scene with at least two classes")
    values = ask_rows(score, partial.v)
    # -inf marks classes that are no candidates. So a candidate of probability 0 gets the smallest
    # finite score.
    values = values.clamp(min=torch.finfo(values.dtype).min)
    values = values.masked_fill((partial.v > 0) | structure, -torch.inf)
    row, target = partial.hidden.nonzero(as_tuple=True)
    others = partial.hidden[row].scatter(1, target.unsqueeze(1), False)
    competing = values[row].masked_fill(others, -torch.inf)
    ranking = Ranking.of(partial.scene[row], target, competing, partial.scenes, 0)
    hits = [
        expected_hits(scores[scores > -np.inf], is_hidden[scores > -np.inf], _FIRST)
        for scores, is_hidden in zip(values.double().numpy(), partial.hidden.numpy(), strict=True)
    ]
    precision = Ratio.of_items(partial.scene.numpy(), np.array(hits), partial.scenes)
    return ranking.mrr(), Ratio(precision.numerators, _FIRST * precision.denominators)


def partial_score(artifact: Artifact, coverage: float | None = None) -> ObjectScore:
    """Return the log-probabilities of `/missing` from labels, see `missing_probabilities`."""

    def score(v: Tensor) -> Tensor:
        scenes = [of_classes(row.nonzero().squeeze(1).tolist()) for row in v]
        p = np.stack([missing_probabilities(artifact, scene, coverage) for scene in scenes])
        return torch.from_numpy(np.log(np.maximum(p, np.finfo(np.float64).tiny)))

    return score


def removed_places(
    scenes: SceneTensors, structure: Tensor, seed: int = 0
) -> tuple[Tensor, Tensor, Places]:
    """Return the indices of the scenes (N,), the removed classes (N,), and the places."""
    removals: list[tuple[int, int, int, int, bool]] = []
    not_structure = ~structure.numpy()
    for k, scene in enumerate(scenes.scenes):
        evidence = scene.evidence
        is_thing = not_structure[evidence.classes]
        if is_thing.sum() < 2:
            continue
        pair = is_thing[:, None] & is_thing & ~np.eye(len(is_thing), dtype=np.bool_)
        triples = np.argwhere(evidence.holds & pair)
        rng = scene_rng(scene, seed)
        for x in np.unique(triples[:, 1:]):
            triples_of_x = triples[(triples[:, 1:] == x).any(1)]
            a, i, j = triples_of_x[rng.integers(len(triples_of_x))].tolist()
            anchor = j if i == x else i
            target, anchor_class = evidence.classes[[x, anchor]].tolist()
            removals.append((k, target, a, anchor_class, bool(i == x)))
    table = torch.tensor(removals, dtype=torch.int64).reshape(-1, 5)
    row, target, relation, anchor, outgoing = table.unbind(1)
    v = scenes.v[row].scatter(1, target.unsqueeze(1), 0.0)
    counts = torch.zeros_like(v)
    for question, k in enumerate(row.tolist()):
        evidence = scenes.scenes[k].evidence
        counts[question, torch.from_numpy(evidence.classes)] = torch.tensor(evidence.counts).float()
    return row, target, Places(v, counts * v, relation, anchor, outgoing.bool())


def leave_one_out_at(
    scenes: SceneTensors, structure: Tensor, score: PlacedScore, *, seed: int = 0
) -> tuple[Ranking, Ints]:
    """Return the rank of every removed class among the absent classes, and its relation (N,)."""
    row, target, places = removed_places(scenes, structure, seed)
    values = places.v
    if len(row):
        index = torch.arange(len(row))
        values = ask_rows(lambda index: score(places.rows(index)), index, block=16)
    values = values.masked_fill((places.v > 0) | structure, -torch.inf)
    skipped = len(scenes) - len(row.unique())
    return Ranking.of(row, target, values, len(scenes), skipped), places.relation.numpy()


def missing_task(model: Model, setting: Setting) -> Outcome | None:
    """Measure T2."""
    if model.missing is None:
        return None
    scenes = setting.scenes
    ranking = leave_one_out(scenes, setting.structure, model.missing)
    if not len(ranking.target):
        return None
    unknown = np.array([len(scene.unknown) for scene in scenes.scenes], dtype=np.int64)
    metrics = ranking.metrics() | {"MRR, unknown labels score 0": ranking.with_unknown(unknown)}
    return Outcome(metrics, len(scenes), ranking.skipped)


def missing_in_room_task(model: Model, setting: Setting) -> Outcome | None:
    """Measure T2 on scenes with a known room type, with and without the room type as evidence."""
    setting = setting.at((setting.scenes.room >= 0).nonzero().squeeze(1))
    scenes, structure, score = setting.scenes, setting.structure, model.missing_in_room
    if score is None or not len(scenes):
        return None
    ranking = leave_one_out(scenes, structure, score, with_room=True)
    if not len(ranking.target):
        return None
    metrics = ranking.metrics()
    if model.missing is not None:
        metrics["MRR, room type withheld"] = leave_one_out(scenes, structure, model.missing).mrr()
    return Outcome(metrics, len(scenes), ranking.skipped)


def partial_task(model: Model, setting: Setting) -> Outcome | None:
    """Measure T2 partial. A published model is also measured with unlisted objects as absent."""
    artifact = model.artifact
    score = model.missing if artifact is None else partial_score(artifact)
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
        mrr, precision = rank_hidden(cases, setting.structure, score)
        metrics |= {f"MRR, {name}": mrr, f"precision@5, {name}": precision}
        if artifact is not None:
            closed_score = partial_score(artifact, _CLOSED)
            closed_mrr, closed_precision = rank_hidden(cases, setting.structure, closed_score)
            metrics |= {
                f"MRR, {name}, unlisted absent": closed_mrr,
                f"change of MRR, {name}": mrr - closed_mrr,
                f"change of precision@5, {name}": precision - closed_precision,
            }
    return Outcome(metrics, len(scenes), skipped)


def placed_task(model: Model, setting: Setting) -> Outcome | None:
    """Measure T2-at. Also measure the same removed classes in requests without the place."""
    if model.at_place is None:
        return None
    scenes, structure = setting.some(related=True, share=3), setting.structure
    ranking, relation = leave_one_out_at(scenes, structure, model.at_place, seed=setting.seed)
    if not len(relation):
        return None
    metrics: dict[str, Metric] = {"MRR": ranking.mrr()}
    for a, name in enumerate(CANONICAL):
        if (relation == a).any():
            metrics[f"MRR, {name}"] = ranking.mrr(relation == a)
    if (objects := model.missing) is not None:
        without_place, _ = leave_one_out_at(
            scenes, structure, lambda places: objects(places.v), seed=setting.seed
        )
        metrics["MRR, place unknown"] = without_place.mrr()
    return Outcome(metrics, len(scenes), ranking.skipped)
