"""Tasks T1a, T1b and T3b: the annotated relations between the classes of a scene.

    T1a   the evidence is the classes
    T1b   the evidence is the classes and a random half of the triples. Given triples a(x, y) and
          their mirror images a(y, x) are not candidates
    T3b   one triple is false. The model scores each triple given the other triples. The false
          triple should rank as the least likely

    T1 with evidence
          the evidence is the relations or poses between the instances of half of the classes. Poses
          also show which relations do not hold; only sources with positions have them. The
          candidates are all other ordered pairs of instances. Each question is asked twice: with
          labels only, and with the evidence. The result is the paired change of R-precision

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

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from app.model import SceneModel
from app.scene import CANONICAL, RelationTable, Scene
from training.datasets.array_types import Rng, Table
from training.datasets.batches import Batch, SceneTensors
from training.datasets.cases import Triple, scene_of, scene_rng
from training.evaluation.asking import ask_every, relation_probabilities
from training.evaluation.metrics import Metric, Ratio, evidence_changes
from training.evaluation.setting import Outcome, RelationScore, Setting, Structure
from training.machines.edges import triple_keys

OF_RELATIONS = ("relations", "poses")  # kinds of evidence for relations (T1)
FIRST = (20, 50, 100)  # numbers of predictions per scene for recall
_TRIES = 50


@dataclass(frozen=True, eq=False)
class Candidates(Table):
    """The ranked triples of one scene."""

    relation: Int[NDArray, " k"]  # canonical
    key: Int[NDArray, " k"]  # number of the triple, see `triple_keys`
    score: Float[NDArray, " k"]
    truth: Bool[NDArray, " k"]  # True if the triple is annotated


def scorable(batch: Batch, structure: Structure) -> Bool[Tensor, "B A n n"]:
    """Return a mask of the triples between two different classes without structure."""
    n = batch.classes.shape[1]
    is_thing = (batch.classes >= 0) & ~structure[batch.classes.clamp(min=0)]
    pair = is_thing[:, :, None] & is_thing[:, None, :] & ~torch.eye(n, dtype=torch.bool)
    return pair[:, None].expand_as(batch.holds)


def with_observed(batch: Batch, observed: Bool[Tensor, "B A n n"] | None = None) -> Batch:
    """Return the batch with only these relations observed, which hold; None means no relation."""
    if observed is None:
        observed = torch.zeros_like(batch.observed)
    return replace(batch, holds=observed.to(batch.holds.dtype), observed=observed)


def _batches(scenes: SceneTensors, triples: int) -> Iterator[tuple[list[int], Batch]]:
    """Yield (indices, batch) of the scenes with at least `triples` annotated triples."""
    related = [k for k, scene in enumerate(scenes.scenes) if scene.evidence.holds.sum() >= triples]
    for index in torch.tensor(related, dtype=torch.int64).split(16) if related else ():
        yield index.tolist(), scenes.batch(index)


@torch.no_grad()
def _scored(
    scenes: SceneTensors, triples: int, ask: Callable[[Batch, list[int]], tuple[Tensor, Tensor]]
) -> list[Candidates]:
    """Return the candidates of the scenes with at least `triples` annotated triples, in order.

    `ask` returns the scores and the mask of the candidates of a batch with these scene indices.
    """
    candidates: list[Candidates] = []
    for index, batch in _batches(scenes, triples):
        values, mask = ask(batch, index)
        for row, classes in enumerate(batch.classes):
            relation, x, y = mask[row].nonzero(as_tuple=True)
            score = values[row, relation, x, y].double().numpy()
            if np.isnan(score).any():
                raise FloatingPointError(f"the score of a triple in scene {row} of a batch is NaN")
            key = triple_keys(relation, classes[x], classes[y], batch.v.shape[1]).numpy()
            truth = (batch.holds[row, relation, x, y] > 0).numpy()
            candidates.append(Candidates(relation.numpy(), key, score, truth))
    return candidates


def score_scenes(
    scenes: SceneTensors, structure: Structure, score: RelationScore, *, counts: bool = True
) -> list[Candidates]:
    """Score the T1a candidates of annotated scenes. Without `counts`, all counts are 0, unknown."""

    def ask(batch: Batch, _: list[int]) -> tuple[Tensor, Tensor]:
        question = with_observed(batch)
        if not counts:
            question = replace(question, counts=torch.zeros_like(batch.counts))
        return score(question), scorable(batch, structure)

    return _scored(scenes, 1, ask)


def complete_scenes(
    scenes: SceneTensors, structure: Structure, score: RelationScore, *, seed: int = 0
) -> list[Candidates]:
    """Score the T1b candidates of scenes with at least two triples.

    Half of the triples of each scene, rounded down, is given.
    """

    def ask(batch: Batch, index: list[int]) -> tuple[Tensor, Tensor]:
        """Observe half of the triples; score the others without mirror images of observed ones."""
        mask = scorable(batch, structure)
        truth = (batch.holds > 0) & mask
        observed = torch.zeros_like(truth)
        for row, k in enumerate(index):
            triples = truth[row].nonzero()
            order = scene_rng(scenes.scenes[k], seed).permutation(len(triples))
            observed[row][tuple(triples[torch.from_numpy(order[: len(triples) // 2])].T)] = True
        # With a single triple the observed half is empty: the scene is left out.
        has_evidence = observed.flatten(1).any(1)[:, None, None, None]
        return score(with_observed(batch, observed)), mask & ~observed & ~observed.mT & has_evidence

    return _scored(scenes, 2, ask)


def r_precision(
    ranked: Iterable[Candidates], scenes: int, *, first: int | None = None
) -> Ratio | None:
    """Return the pooled share of annotated triples among the `first` candidates of each scene.

    By default, `first` is the number of annotated triples. Without such triples, return None.
    """
    hits, annotated = np.zeros((2, scenes))
    for k, scene in enumerate(ranked):
        if count := int(scene.truth.sum()):
            annotated[k] = count
            hits[k] = expected_hits(scene.score, scene.truth, first or count)
    return Ratio(hits, annotated) if annotated.any() else None


def unseen(
    scored: Sequence[Candidates], seen: Int[Tensor, "triples 3"], classes: int
) -> list[Candidates]:
    """Select the candidates that are not among the training triples `seen` (zero-shot)."""
    relation, subject, object_ = seen.long().unbind(1)
    keys = triple_keys(relation, subject, object_, classes).numpy()
    return [scene.rows(~np.isin(scene.key, keys)) for scene in scored]


def expected_hits(score: Float[NDArray, " k"], truth: Bool[NDArray, " k"], count: int) -> float:
    """Return the expected number of true items among the first `count`; ties in random order."""
    if count >= len(score):
        return float(truth.sum())
    threshold = np.partition(score, -count)[-count]
    is_above, is_tied = score > threshold, score == threshold
    share = (count - is_above.sum()) / is_tied.sum()
    return float(truth[is_above].sum() + share * truth[is_tied].sum())


def draw_false_triple(
    holds: Bool[NDArray, "A n n"], usable: Bool[NDArray, "A n n"], rng: Rng
) -> tuple[Triple, Triple] | None:
    """Draw a true triple (relation, subject, object) of a scene and a false replacement.

    The replacement changes the relation (probability 1/2), the subject (1/4) or the object (1/4).
    Return None with fewer than two usable true triples, or if all `_TRIES` draws fail.
    """
    true_triples = np.argwhere(holds & usable)
    if len(true_triples) < 2:
        return None
    A, n, _ = holds.shape
    relation, subject, object_ = true_triples[rng.integers(len(true_triples))].tolist()
    for _ in range(_TRIES):
        change, new_class = rng.random(), int(rng.integers(n))
        if change < 0.5:
            a, i, j = int(rng.integers(A)), subject, object_
        elif change < 0.75:
            a, i, j = relation, subject, new_class
        else:
            a, i, j = relation, new_class, object_
        if usable[a, i, j] and not holds[a, i, j] and not holds[a, j, i]:
            return (relation, subject, object_), (a, i, j)
    return None


@torch.no_grad()
def false_hits(
    scenes: SceneTensors, structure: Structure, score: RelationScore, *, seed: int = 0
) -> Ratio | None:
    """Return the share of false triples that rank first in their scene; None without any.

    `score` must judge each observed triple without using that triple.
    """
    hits: list[tuple[int, float]] = []
    for index, batch in _batches(scenes, 2):
        mask = scorable(batch, structure)
        truth = (batch.holds > 0) & mask
        observed, is_false = torch.zeros_like(truth), torch.zeros_like(truth)
        for row, k in enumerate(index):
            rng = scene_rng(scenes.scenes[k], seed)
            if case := draw_false_triple(batch.holds[row].numpy() > 0, mask[row].numpy(), rng):
                true_triple, false_triple = case
                observed[row] = truth[row]
                observed[row][true_triple] = False
                observed[row][false_triple] = is_false[row][false_triple] = True
        log_odds = score(with_observed(batch, observed)).double()
        for row, k in enumerate(index):
            stated = observed[row]
            if stated.any():
                suspicion, target = -log_odds[row][stated].numpy(), is_false[row][stated].numpy()
                hits.append((k, expected_hits(suspicion, target, 1)))
    if not hits:
        return None
    scene, values = zip(*hits, strict=True)
    return Ratio.of_items(np.array(scene), np.array(values), len(scenes))


def relations_task(score: RelationScore, setting: Setting) -> Outcome | None:
    """Measure T1a: R-precision of the relations of a scene, given its classes."""
    scenes, structure = setting.scenes, setting.structure
    with_counts = score_scenes(scenes, structure, score)
    uncounted = score_scenes(scenes, structure, score, counts=False)
    ranking, counted = (r_precision(scored, len(scenes)) for scored in (uncounted, with_counts))
    if ranking is None or counted is None:
        return None
    metrics: dict[str, Metric] = {
        "R-precision, distinct classes": ranking,
        "R-precision, instance counts": counted,
        "R-precision, distinct classes, mean over scenes": ranking.mean_over_scenes(),
        "R-precision, mean over scenes": counted.mean_over_scenes(),
    }
    return Outcome.over(scenes, metrics | _details(with_counts, setting), ranking.skipped)


def completion_task(score: RelationScore, setting: Setting) -> Outcome | None:
    """Measure T1b: R-precision of half of the relations, given the other half."""
    scenes = setting.scenes
    candidates = complete_scenes(scenes, setting.structure, score, seed=setting.seed)
    ranking = r_precision(candidates, len(scenes))
    if ranking is None:
        return None
    metrics: dict[str, Metric] = {
        "R-precision": ranking,
        "R-precision, mean over scenes": ranking.mean_over_scenes(),
    }
    return Outcome.over(scenes, metrics | _details(candidates, setting), ranking.skipped)


def _details(scored: list[Candidates], setting: Setting) -> dict[str, Metric]:
    """Return R-precision by relation, recall at k, and R-precision of unseen triples."""
    count = len(setting.scenes)
    metrics: dict[str, Ratio | None] = {}
    for a, name in enumerate(CANONICAL):
        candidates = [scene.rows(scene.relation == a) for scene in scored]
        metrics[f"R-precision, {name}"] = r_precision(candidates, count)
    for k in FIRST:
        recall = r_precision(scored, count, first=k)
        metrics[f"R@{k}"] = recall and recall.mean_over_scenes()
    if setting.seen is not None:
        new = unseen(scored, setting.seen, setting.scenes.v.shape[1])
        metrics["R-precision, zero-shot"] = r_precision(new, count)
    return {name: metric for name, metric in metrics.items() if metric is not None}


def placement_task(score: RelationScore, setting: Setting) -> Outcome | None:
    """Measure T3b: the share of scenes whose false triple is the least likely one."""
    scenes = setting.some(related=True)
    hits = false_hits(scenes, setting.structure, score, seed=setting.seed)
    return None if hits is None else Outcome.over(scenes, {"hit@1": hits}, hits.skipped)


class Case(NamedTuple):
    """One question of T1."""

    scene_index: int
    scene: Scene  # with the evidence
    queried: Bool[NDArray, "A objects objects"]
    truth: Bool[NDArray, "A objects objects"]  # queried relations that hold


def evidence_cases(
    scenes: SceneTensors, structure: Bool[NDArray, " V"], kind: str, seed: int = 0
) -> Iterator[Case]:
    """Generate the T1 questions: evidence about half of the classes, all other pairs queried.

    If `kind` is "poses", boxes show the evidence; otherwise the request states it.
    """
    for index, encoded in enumerate(scenes.scenes):
        instances, classes = encoded.instance_classes, encoded.evidence.classes
        things = classes[~structure[classes]]
        if len(things) < 3 or (kind == "poses" and encoded.instance_positions is None):
            continue
        # A relation needs two classes, so the evidence is about at least two of them.
        half = scene_rng(encoded, seed).permutation(things)[: max(2, len(things) // 2)]
        in_half, is_thing = np.isin(instances, half), ~structure[instances]
        between = in_half[:, None] & in_half
        pair = is_thing[:, None] & is_thing & ~between & ~np.eye(len(instances), dtype=np.bool_)
        queried = np.broadcast_to(pair, encoded.instance_holds.shape)
        truth, evidence = encoded.instance_holds & queried, encoded.instance_holds & between
        if not truth.any() or not evidence.any():
            continue
        triples = [(int(a), int(i), int(j)) for a, i, j in np.argwhere(evidence)]
        scene = replace(scene_of(encoded, range(len(instances)), triples), room_type=None)
        if kind == "poses":
            observed = encoded.instance_observed & between
            excluded = np.zeros_like(observed)  # the boxes exclude nothing about queried pairs
            table = RelationTable.shown_by_boxes(evidence, observed, excluded)
            scene = replace(scene, relations=table)
        yield Case(index, scene, queried, truth)


def relations_evidence_task(artifact: SceneModel, setting: Setting) -> Outcome | None:
    """Measure T1 of instances with labels only, and with relations or poses."""
    scenes, structure = setting.some(related=True), setting.structure.numpy()
    metrics: dict[str, Metric] = {}
    skipped: list[int] = []

    def ask(case: Case) -> Float[NDArray, " 2"]:
        """Return the expected hits without and with the evidence of a case."""
        count, truth = int(case.truth.sum()), case.truth[case.queried]
        bare = replace(case.scene, relations=None)
        answers = (relation_probabilities(artifact, scene) for scene in (bare, case.scene))
        return np.array([expected_hits(p[case.queried], truth, count) for p in answers])

    for kind in OF_RELATIONS:
        cases = list(evidence_cases(scenes, structure, kind, setting.seed))
        if not cases:
            continue
        without, informed, items = np.zeros((3, len(scenes)))
        for case, hits in zip(cases, ask_every(ask, cases), strict=True):
            without[case.scene_index], informed[case.scene_index] = hits
            items[case.scene_index] = case.truth.sum()
        ratios = Ratio(without, items), Ratio(informed, items)
        metrics |= evidence_changes("R-precision", kind, *ratios)
        skipped.append(int((items == 0).sum()))
    return Outcome.over(scenes, metrics, skipped[0] if skipped else 0)
