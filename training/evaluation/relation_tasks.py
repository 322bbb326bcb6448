"""Tasks T1a, T1b and T3b: the annotated relations between the classes of a scene.

    T1a   the evidence is the classes
    T1b   the evidence is the classes and a random half of the triples. Given triples a(x, y) and
          their mirror images a(y, x) are not candidates
    T3b   one triple is false. The model scores each triple given the other triples. The false
          triple should rank as the least likely

The metric of T1 is R-precision: the number of predictions is the number of annotated triples. The
candidates are all ordered pairs i ≠ j of present classes × canonical relations. An unlisted triple
counts as wrong, although annotators list only a few relations per scene. Structure classes are
excluded. Scenes without annotated triples are skipped; T1b and T3b need two triples.

Triples are canonical and distinct. So the evidence of T1b never contains a held-out relation in its
opposite form (right for left). Relations outside the evidence are unobserved.

The false triple of T3b has another relation between the two classes, or another present class at
one end, with equal probability. The scene annotates neither the false triple nor its mirror image,
because the other triples would contradict these directly.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from app.scene import CANONICAL
from training.datasets.array_types import Flags, Floats, Ints, Rng
from training.datasets.batches import Batch, SceneTensors
from training.datasets.cases import Triple, scene_rng
from training.evaluation.metrics import Items, Metric, Ratio
from training.evaluation.model import RelationScore
from training.evaluation.setting import Outcome, Setting
from training.machines.edges import triple_keys

FIRST = (1, 2, 5, 10, 20, 50, 100)
"""Numbers of predictions per scene for recall."""
_RECALLS = (20, 50, 100)
_TRIES = 50


@dataclass(frozen=True, eq=False)
class Candidates:
    """The k ranked triples of one scene.

    Attributes:
        scene: index of the scene among the scored scenes.
        relation: (k,) int64, index of the canonical relation.
        key: (k,) int64, number of the triple, see `triple_keys`.
        score: (k,) score of each triple. A higher score means more likely true.
        truth: (k,) bool, the triple is annotated.
    """

    scene: int
    relation: Ints
    key: Ints
    score: Floats
    truth: Flags

    def where(self, mask: Flags) -> Candidates:
        """Select the triples with a True value in `mask` (k,)."""
        scene, *columns = vars(self).values()
        return Candidates(scene, *(column[mask] for column in columns))


def scorable(batch: Batch, structure: Tensor) -> Tensor:
    """Return a mask (B, A, n, n) of triples between two different classes without structure."""
    n = batch.classes.shape[1]
    is_thing = (batch.classes >= 0) & ~structure[batch.classes.clamp(min=0)]
    pair = is_thing[:, :, None] & is_thing[:, None, :] & ~torch.eye(n, dtype=torch.bool)
    return pair[:, None].expand_as(batch.holds)


def telling(batch: Batch, given: Tensor | None = None) -> Batch:
    """Return the batch with only the given relations (B, A, n, n) observed."""
    if given is None:
        given = torch.zeros_like(batch.observed)
    return replace(batch, holds=given.to(batch.holds.dtype), observed=given)


def _batches(scenes: SceneTensors, triples: int) -> Iterator[tuple[list[int], Batch]]:
    """Yield (indices, batch) of the scenes with at least `triples` annotated triples."""
    related = [k for k, scene in enumerate(scenes.scenes) if scene.evidence.holds.sum() >= triples]
    for index in torch.tensor(related, dtype=torch.int64).split(16) if related else ():
        yield index.tolist(), scenes.batch(index)


def _candidates(batches: Iterable[tuple[Batch, Tensor, Tensor]]) -> list[Candidates]:
    """Return the candidates of every scene, numbered in order."""
    candidates: list[Candidates] = []
    for batch, values, mask in batches:
        for row, classes in enumerate(batch.classes):
            relation, x, y = mask[row].nonzero(as_tuple=True)
            score = values[row, relation, x, y].double().numpy()
            if np.isnan(score).any():
                raise FloatingPointError(f"the score of a triple in scene {row} of a batch is NaN")
            key = triple_keys(relation, classes[x], classes[y], batch.v.shape[1]).numpy()
            truth = (batch.holds[row, relation, x, y] > 0).numpy()
            candidates.append(Candidates(len(candidates), relation.numpy(), key, score, truth))
    return candidates


@torch.no_grad()
def score_scenes(
    scenes: SceneTensors, structure: Tensor, score: RelationScore, *, counts: bool = True
) -> list[Candidates]:
    """Score the T1a candidates of annotated scenes. Without `counts`, all counts are 0, unknown."""

    def scored() -> Iterator[tuple[Batch, Tensor, Tensor]]:
        for _, batch in _batches(scenes, 1):
            question = telling(batch)
            if not counts:
                question = replace(question, counts=torch.zeros_like(batch.counts))
            yield batch, score(question), scorable(batch, structure)

    return _candidates(scored())


@torch.no_grad()
def complete_scenes(
    scenes: SceneTensors, structure: Tensor, score: RelationScore, *, seed: int = 0
) -> list[Candidates]:
    """Score the T1b candidates of scenes with at least two triples, given half of the triples."""

    def scored() -> Iterator[tuple[Batch, Tensor, Tensor]]:
        for index, batch in _batches(scenes, 2):
            mask = scorable(batch, structure)
            given = random_half((batch.holds > 0) & mask, scenes, index, seed)
            # With a single triple the observed half is empty: the scene is left out.
            has_evidence = given.flatten(1).any(1)[:, None, None, None]
            yield batch, score(telling(batch, given)), mask & ~given & ~given.mT & has_evidence

    return _candidates(scored())


def random_half(truth: Tensor, scenes: SceneTensors, index: Sequence[int], seed: int) -> Tensor:
    """Return half of each scene's triples (rounded down), (B, A, n, n) bool."""
    half = torch.zeros_like(truth)
    for row, k in enumerate(index):
        triples = truth[row].nonzero()
        order = scene_rng(scenes.scenes[k], seed).permutation(len(triples))
        chosen = triples[torch.from_numpy(order[: len(triples) // 2])]
        half[row][tuple(chosen.T)] = True
    return half


@dataclass(frozen=True, eq=False)
class RelationRanking:
    """Number of annotated triples of each scene, and of hits among the predictions, (scenes,)."""

    annotated: Ints
    hits: Floats

    @property
    def skipped(self) -> int:
        """Number of scenes without annotated triples."""
        return int((self.annotated == 0).sum())

    def pooled(self) -> Ratio:
        """Return the R-precision pooled over scenes."""
        return Ratio(self.hits, self.annotated.astype(np.float64))

    def per_scene(self) -> Ratio:
        """Return the mean over scenes of their R-precision."""
        return self.pooled().mean_over_scenes()


def rank(ranked: Iterable[Candidates], scenes: int, *, first: int | None = None) -> RelationRanking:
    """Count annotated triples among the first candidates, by default as many as are annotated."""
    annotated, hits = np.zeros(scenes, dtype=np.int64), np.zeros(scenes)
    for scene in ranked:
        if count := int(scene.truth.sum()):
            annotated[scene.scene] = count
            hits[scene.scene] = expected_hits(scene.score, scene.truth, first or count)
    return RelationRanking(annotated, hits)


def rank_relations(
    scenes: SceneTensors, structure: Tensor, score: RelationScore
) -> RelationRanking:
    """Compute the R-precision of a score on a set of scenes."""
    return rank(score_scenes(scenes, structure, score), len(scenes))


def unseen(scored: Sequence[Candidates], seen: Tensor, classes: int) -> list[Candidates]:
    """Select the candidates that are not among the training triples `seen`, (T, 3) (zero-shot)."""
    relation, subject, object_ = seen.long().unbind(1)
    keys = triple_keys(relation, subject, object_, classes).numpy()
    return [scene.where(~np.isin(scene.key, keys)) for scene in scored]


def expected_hits(score: Floats, truth: Flags, count: int) -> float:
    """Return the expected number of true items among the first `count`; ties in random order."""
    if count >= len(score):
        return float(truth.sum())
    threshold = np.partition(score, -count)[-count]
    is_above, is_tied = score > threshold, score == threshold
    share = (count - is_above.sum()) / is_tied.sum()
    return float(truth[is_above].sum() + share * truth[is_tied].sum())


def alter(holds: Flags, allowed: Flags, rng: Rng) -> tuple[Triple, Triple] | None:
    """Draw a true triple (relation, subject, object) of a scene and a false replacement.

    The replacement changes the relation with probability 1/2, the subject with probability 1/4 and
    the object with probability 1/4. It is false if the scene lists neither it nor its mirror
    image.

    Args:
        holds: True for triples that hold, (A, n, n) for n classes.
        allowed: True for triples that the task may use, (A, n, n).

    Returns:
        The true triple and the false triple. The result is None if the scene has fewer than two
        true triples, or if `_TRIES` draws give no false triple.
    """
    true_triples = np.argwhere(holds & allowed)
    if len(true_triples) < 2:
        return None
    A, n, _ = holds.shape
    relation, subject, object_ = true_triples[rng.integers(len(true_triples))].tolist()
    for _ in range(_TRIES):
        part, new_class = rng.random(), int(rng.integers(n))
        if part < 0.5:
            a, i, j = int(rng.integers(A)), subject, object_
        elif part < 0.75:
            a, i, j = relation, subject, new_class
        else:
            a, i, j = relation, new_class, object_
        if allowed[a, i, j] and not holds[a, i, j] and not holds[a, j, i]:
            return (relation, subject, object_), (a, i, j)
    return None


@torch.no_grad()
def placement_scores(
    scenes: SceneTensors, structure: Tensor, score: RelationScore, *, seed: int = 0
) -> Items:
    """Return the suspicion that each triple is false, in scenes with one false triple.

    The truth of an item is True for the false triple. `score` must judge each observed triple
    without using that triple.
    """
    parts: list[Tensor] = [torch.zeros(0, 3, dtype=torch.float64)]
    for index, batch in _batches(scenes, 2):
        mask = scorable(batch, structure)
        truth = (batch.holds > 0) & mask
        observed, is_false = torch.zeros_like(truth), torch.zeros_like(truth)
        for row, k in enumerate(index):
            rng = scene_rng(scenes.scenes[k], seed)
            if case := alter(batch.holds[row].numpy() > 0, mask[row].numpy(), rng):
                true_triple, false_triple = case
                observed[row] = truth[row]
                observed[row][true_triple] = False
                observed[row][false_triple] = is_false[row][false_triple] = True
        log_odds = score(telling(batch, observed))[observed].double()
        scene_index = torch.tensor(index)[observed.nonzero()[:, 0]]
        parts.append(torch.stack([scene_index, -log_odds, is_false[observed]], 1))
    scene, suspicion, false = torch.cat(parts).numpy().T
    skipped = len(scenes) - len(np.unique(scene))
    return Items(scene.astype(np.int64), suspicion, false > 0, len(scenes), skipped)


def relations_task(score: RelationScore, setting: Setting) -> Outcome | None:
    """Measure T1a."""
    scenes, structure = setting.scenes, setting.structure
    with_counts = score_scenes(scenes, structure, score)
    uncounted = score_scenes(scenes, structure, score, counts=False)
    if not _any_true(uncounted):
        return None
    ranking, counted = rank(uncounted, len(scenes)), rank(with_counts, len(scenes))
    metrics: dict[str, Metric] = {
        "R-precision, distinct classes": ranking.pooled(),
        "R-precision, instance counts": counted.pooled(),
        "R-precision, distinct classes, mean over scenes": ranking.per_scene(),
        "R-precision, mean over scenes": counted.per_scene(),
    }
    metrics |= _details(with_counts, setting, FIRST)
    return Outcome.over(scenes, metrics, ranking.skipped)


def completion_task(score: RelationScore, setting: Setting) -> Outcome | None:
    """Measure T1b."""
    scenes = setting.scenes
    candidates = complete_scenes(scenes, setting.structure, score, seed=setting.seed)
    if not _any_true(candidates):
        return None
    ranking = rank(candidates, len(scenes))
    metrics: dict[str, Metric] = {
        "R-precision": ranking.pooled(),
        "R-precision, mean over scenes": ranking.per_scene(),
    }
    metrics |= _details(candidates, setting, _RECALLS)
    return Outcome.over(scenes, metrics, ranking.skipped)


def _any_true(scored: list[Candidates]) -> bool:
    return any(scene.truth.any() for scene in scored)


def _details(scored: list[Candidates], setting: Setting, first: Sequence[int]) -> dict[str, Metric]:
    """Return R-precision by relation, recall at k, and R-precision of unseen triples."""
    count = len(setting.scenes)
    metrics: dict[str, Metric] = {}
    for a, name in enumerate(CANONICAL):
        candidates = [scene.where(scene.relation == a) for scene in scored]
        if _any_true(candidates):
            metrics[f"R-precision, {name}"] = rank(candidates, count).pooled()
    for k in first:
        metrics[f"R@{k}"] = rank(scored, count, first=k).per_scene()
    if setting.seen is not None:
        new = unseen(scored, setting.seen, setting.scenes.v.shape[1])
        if _any_true(new):
            metrics["R-precision, zero-shot"] = rank(new, count).pooled()
    return metrics


def placement_task(score: RelationScore, setting: Setting) -> Outcome | None:
    """Measure T3b."""
    scenes = setting.some(related=True)
    scores = placement_scores(scenes, setting.structure, score, seed=setting.seed)
    metrics = {"hit@1": scores.hit_at_1()} if len(scores.scene) else {}
    return Outcome.over(scenes, metrics, scores.skipped)
