"""Relation baselines, and baselines for objects at a place, from counts of triples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import softplus

from training.baselines.fitting import Proposals
from training.baselines.objects import frequency
from training.batches import Batch, SceneTensors
from training.evaluation.missing import ObjectScore, PlacedScore, Places
from training.evaluation.relations import RelationScore, transitive_closure

# Counts of each relation per pair of classes, and score tables of that shape.


@dataclass(frozen=True, eq=False)
class TripleCounts:
    """Number of scenes per (a, i, j); structure classes and i = j are not counted.

    Attributes:
        held: (A, V, V) number of scenes in which the relation held.
        together: (V, V) number of scenes with annotated relations that contain both classes.
    """

    held: Tensor
    together: Tensor

    def overall(self) -> Tensor:
        """Return p(r) over all pairs of classes, (A,), with add-one (Laplace) smoothing."""
        return (self.held.sum((1, 2)) + 1.0) / (self.together.sum() + 2.0)


def count_triples(scenes: SceneTensors, structure: Tensor) -> TripleCounts:
    """Count triples over the scenes with annotated relations.

    A relation that is not listed counts as false, as in task T1, even if the geometry left the pair
    unobserved. Rates among observed pairs overrate relations that are annotated only where they
    hold. They lower the validation R-precision: .343 to .323 on procthor, .34 to .10 on bedrooms.

    Raises:
        ValueError: all scenes lack observed relations.
    """
    V = scenes.v.shape[1]
    related = [scene.evidence for scene in scenes.scenes if scene.evidence.observed.any()]
    if not related:
        raise ValueError(f"the {len(scenes)} training scenes contain no observed relation")
    A = related[0].holds.shape[0]
    held = np.zeros((A, V, V), dtype=np.float32)
    together = np.zeros((V, V), dtype=np.float32)
    for e in related:
        held[np.ix_(np.arange(A), e.classes, e.classes)] += e.holds
        together[np.ix_(e.classes, e.classes)] += 1.0
    skip = structure.numpy()
    pair = ~(skip[:, None] | skip | np.eye(V, dtype=np.bool_))
    return TripleCounts(torch.from_numpy(held * pair), torch.from_numpy(together * pair))


@dataclass(frozen=True, eq=False)
class TripleTable:
    """A relation score from a table: table[a, i, j] + g · log(n_i n_j).

    The score uses the classes and instance counts of a batch. It ignores the relations.

    Attributes:
        log_odds: (A, V, V), by relation, subject class and object class.
        multiplicity: g, weight of the instance counts; 0 ignores counts.
    """

    log_odds: Tensor
    multiplicity: float = 0.0

    def __call__(self, batch: Batch) -> Tensor:
        """Return log-odds (B, A, n, n); padded entries are undefined."""
        index = batch.classes.clamp(min=0)
        values = self.log_odds[:, index[:, :, None], index[:, None, :]].movedim(0, 1)
        if self.multiplicity:
            logs = batch.counts.clamp(min=1).to(values.dtype).log()
            values = values + self.multiplicity * (logs[:, None, :, None] + logs[:, None, None, :])
        return values


# Frequency of each relation over all pairs of classes.


def relation_popularity(
    train: SceneTensors, structure: Tensor, _seed: int
) -> Proposals[RelationScore]:
    """Yield the overall log-odds of each relation, the only grid point."""
    counts = count_triples(train, structure)
    overall = counts.overall().logit()[:, None, None]
    yield {}, TripleTable(overall.expand_as(counts.held))


# Smoothed frequency table p(r | i, j): a strong baseline for relations.
#
# R. Zellers et al., "Neural Motifs: Scene Graph Parsing with Global Context", CVPR 2018, show that
# the labels of subject and object predict most relations. A rare pair backs off to its two classes,
# and a rare class backs off to p(r):
#
#     p(r | i, j) = (held + s · [p(r | i as subject) + p(r | j as object)] / 2) / (together + s)
#     p(r | i)    = (held with i + m · p(r)) / (pairs with i + m), likewise p(r | j)


_PAIR = (1.0, 3.0, 10.0, 30.0, 100.0)
_END = (3.0, 30.0)
_MULTIPLICITY = (0.0, 0.5, 1.0)


def smoothed_log_odds(counts: TripleCounts, pair: float, end: float) -> Tensor:
    """Return logit p(r | i, j), (A, V, V).

    Args:
        pair: s > 0, number of back-off cases added to a pair of classes.
        end: m > 0, number of back-off cases, distributed as p(r), added to a class.
    """
    overall = counts.overall()[:, None]
    subject = (counts.held.sum(2) + end * overall) / (counts.together.sum(1) + end)
    object_ = (counts.held.sum(1) + end * overall) / (counts.together.sum(0) + end)
    back_off = (subject[:, :, None] + object_[:, None, :]) / 2
    return ((counts.held + pair * back_off) / (counts.together + pair)).logit(eps=1e-7)


def frequency_table(train: SceneTensors, structure: Tensor, _seed: int) -> Proposals[RelationScore]:
    """Yield a score for each pair smoothing, class smoothing and weight of the instance counts.

    The weight has no effect if all counts are set to 1.
    """
    counts = count_triples(train, structure)
    for pair in _PAIR:
        for end in _END:
            table = smoothed_log_odds(counts, pair, end)
            for weight in _MULTIPLICITY:
                parameters = {"pair": pair, "end": end, "multiplicity": weight}
                yield parameters, TripleTable(table, weight)


# ComplEx: complex class embeddings, which can give left(i, j) and left(j, i) different scores.
#
# T. Trouillon et al., "Complex Embeddings for Simple Link Prediction", ICML 2016, equation 11:
# logit p(a, i, j) = d_a + Re sum_k S[i,k] R[a,k] conj(S[j,k]). The model is fitted to all pairs of
# classes that occur together. Each triple is a binomial: `held` successes in `together` trials. The
# penalty is the nuclear 3-norm of T. Lacroix et al., ICML 2018.


_RANKS = (16, 64)
_PENALTIES = (0.03, 0.1, 0.3)
_COMPLEX_MULTIPLICITY = (0.0, 1.0)
_STEPS = 200
_LEARNING_RATE = 0.05


def fit_complex(
    counts: TripleCounts, *, rank: int, penalty: float, seed: int, steps: int = _STEPS
) -> Tensor:
    """Fit ComplEx and return its logits (A, V, V).

    Args:
        rank: number of complex dimensions.
        penalty: weight of the mean cubed modulus of the factors of each pair.
        steps: number of Adam steps over all pairs; the learning rate falls to 0.
    """
    generator = torch.Generator().manual_seed(seed)
    A, V, _ = counts.held.shape

    def factors(rows: int, scale: float) -> Tensor:
        values = torch.randn(rows, rank, dtype=torch.cfloat, generator=generator)
        return (scale * values).requires_grad_()

    classes, relations = factors(V, 0.1), factors(A, 1.0)
    bias = counts.overall().logit().requires_grad_()
    i, j = counts.together.nonzero(as_tuple=True)
    trials, held = counts.together[i, j], counts.held[:, i, j]
    optimiser = torch.optim.Adam([classes, relations, bias], lr=_LEARNING_RATE)
    cycle = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        optimiser.zero_grad()
        values = complex_logits(bias, relations, classes)[:, i, j]
        misfit = (trials * softplus(values) - held * values).sum()
        size = classes.abs() ** 3
        norm = (size[i] + size[j]).sum() + len(i) / A * (relations.abs() ** 3).sum()
        ((misfit + penalty * norm) / len(i)).backward()
        optimiser.step()
        cycle.step()
    with torch.no_grad():
        return complex_logits(bias, relations, classes)


def complex_logits(bias: Tensor, relations: Tensor, classes: Tensor) -> Tensor:
    """Return d_a + Re <S_i, R_a, conj S_j>; bias (A,), relations (A, K), classes (V, K)."""
    turned = classes * relations[:, None]
    # Re(x conj(y)) = Re x Re y + Im x Im y. Two real products are faster than a complex one.
    real = turned.real @ classes.real.T + turned.imag @ classes.imag.T
    return bias[:, None, None] + real


def complex_embedding(
    train: SceneTensors, structure: Tensor, seed: int
) -> Proposals[RelationScore]:
    """Yield a score for each rank, penalty and weight of the instance counts."""
    counts = count_triples(train, structure)
    for rank in _RANKS:
        for penalty in _PENALTIES:
            table = fit_complex(counts, rank=rank, penalty=penalty, seed=seed)
            for weight in _COMPLEX_MULTIPLICITY:
                parameters = {"rank": rank, "penalty": penalty, "multiplicity": weight}
                yield parameters, TripleTable(table, weight)


# Completion by logic: the frequency table, adjusted by consequences of the observed relations.
#
# The score adds a bonus to a relation a(i, k) that follows by transitivity from observed a(i, j)
# and a(j, k). It subtracts a penalty from the reverse a(k, i) of each observed or implied relation.
# The canonical relations store right as left with exchanged ends (inverse closure). Bonus and
# penalty are finite for two reasons: classes may have several instances, and annotated on-top is
# not always transitive.
#
# Task T1b marks only the evidence of a scene as observed, not the full annotation. This score
# needs such batches.


_CLOSURE_PAIR = (3.0, 10.0, 30.0)
_CLOSURE_END = 30.0
_CLOSURE_MULTIPLICITY = (0.5, 1.0)
_BONUS = (0.0, 1.0, 2.0, 4.0)
_PENALTY = (0.0, 1.0, 3.0)


@dataclass(frozen=True, eq=False)
class ClosureScore:
    """table + bonus · [implied relation] - penalty · [reverse of an observed or implied relation].

    Attributes:
        table: log-odds without evidence.
        bonus, penalty: changes of the log-odds, >= 0.
    """

    table: TripleTable
    bonus: float
    penalty: float

    def __call__(self, batch: Batch) -> Tensor:
        """Return log-odds (B, A, n, n) given the observed relations of the batch."""
        given = (batch.holds > 0) & batch.observed
        closed = transitive_closure(given)
        follows, mirror = closed & ~given, closed.mT & ~closed
        return self.table(batch) + self.bonus * follows - self.penalty * mirror


def frequency_table_with_closure(
    train: SceneTensors, structure: Tensor, _seed: int
) -> Proposals[RelationScore]:
    """Yield a score for each smoothing, weight of the counts, bonus and penalty."""
    counts = count_triples(train, structure)
    for pair in _CLOSURE_PAIR:
        log_odds = smoothed_log_odds(counts, pair, _CLOSURE_END)
        for weight in _CLOSURE_MULTIPLICITY:
            table = TripleTable(log_odds, weight)
            for bonus in _BONUS:
                for penalty in _PENALTY:
                    parameters = {"pair": pair, "multiplicity": weight, "bonus": bonus}
                    yield parameters | {"penalty": penalty}, ClosureScore(table, bonus, penalty)


# Baselines for an object i at a place (a, j), such as "on-top of the desk": the frequency table
# p(i | a, j), and the product of this table and an object score.
#
#     p(i | a, j) = (held + s · p(i | a)) / (held by any + s)
#
# p(i | a) is smoothed in the same way towards p(i), with weight m. There are separate tables for i
# as subject and i as object. The product adds the log-odds given the other objects of the scene,
#
#     score(i | rest) + w · log p(i | a, j) - u · log p(i),
#
# where the last term corrects for the class frequency that both factors contain.


_PLACE = (0.3, 1.0, 3.0, 10.0)
_RELATION = (1.0, 10.0)
_WEIGHTS = (0.25, 0.5, 0.75, 1.0)
_CORRECTIONS = (0.0, 0.5, 1.0)


@dataclass(frozen=True, eq=False)
class PlacedTable:
    """The score log p(i | a, j) from a table.

    Attributes:
        log_p: (2, A, V, V), by `Places.outgoing`, relation, anchor class and removed class.
    """

    log_p: Tensor

    def __call__(self, places: Places) -> Tensor:
        """Return log p(i | a, j), (B, V)."""
        return self.log_p[places.outgoing.long(), places.relation, places.anchor]


@dataclass(frozen=True, eq=False)
class PlacedProduct:
    """Score: objects(v) + weight · table - correction · log popularity (V,)."""

    objects: ObjectScore
    table: PlacedTable
    log_popularity: Tensor
    weight: float
    correction: float

    def __call__(self, places: Places) -> Tensor:
        """Return scores (B, V)."""
        added = self.weight * self.table(places) - self.correction * self.log_popularity
        return self.objects(places.v) + added


def smoothed_log_p(
    counts: TripleCounts, popularity: Tensor, place: float, relation: float
) -> Tensor:
    """Return log p(i | a, j), (2, A, V, V) as in `PlacedTable`.

    Args:
        popularity: p(i), (V,); the function normalises it.
        place: s > 0, number of cases of p(i | a) added to each (a, j).
        relation: m > 0, number of cases of p(i) added to each a.
    """
    # In the second table, the removed class is the subject. Its transpose puts the anchor first.
    held = torch.stack([counts.held, counts.held.mT])
    share = popularity / popularity.sum()
    any_anchor = held.sum(2)
    back_off = any_anchor + relation * share
    back_off = back_off / back_off.sum(-1, keepdim=True)
    table = held + place * back_off.unsqueeze(2)
    return (table / (held.sum(-1, keepdim=True) + place)).log()


def placed_table(train: SceneTensors, structure: Tensor, _seed: int) -> Proposals[PlacedScore]:
    """Yield a score for each smoothing of places and of relations."""
    counts = count_triples(train, structure)
    for place in _PLACE:
        for relation in _RELATION:
            log_p = smoothed_log_p(counts, frequency(train.v), place, relation)
            yield {"place": place, "relation": relation}, PlacedTable(log_p)


def times(
    objects: ObjectScore, table: PlacedTable
) -> Callable[[SceneTensors, Tensor, int], Proposals[PlacedScore]]:
    """Return a baseline: the product of a fitted object score and a fitted table."""

    def placed_table(train: SceneTensors, _structure: Tensor, _seed: int) -> Proposals[PlacedScore]:
        log_popularity = frequency(train.v).log()
        for weight in _WEIGHTS:
            for correction in _CORRECTIONS:
                score = PlacedProduct(objects, table, log_popularity, weight, correction)
                yield {"weight": weight, "correction": correction}, score

    return placed_table
