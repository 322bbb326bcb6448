"""Baselines for relations, and for objects at a place, from counts of triples."""

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

# Counts of triples (relation a, subject class i, object class j), and score tables over triples.


@dataclass(frozen=True, eq=False)
class TripleCounts:
    """Numbers of scenes with each triple (relation a, subject class i, object class j).

    Structure classes, and triples with i = j, have the count 0.

    Attributes:
        held: number of scenes in which the relation holds, (relations, classes, classes).
        together: number of scenes with annotated relations that contain both classes, (classes,
            classes).
    """

    held: Tensor
    together: Tensor

    def overall(self) -> Tensor:
        """Return the add-one smoothed probability of each relation over all pairs, (relations,)."""
        return (self.held.sum((1, 2)) + 1.0) / (self.together.sum() + 2.0)


def count_triples(scenes: SceneTensors, structure: Tensor) -> TripleCounts:
    """Count triples over the scenes with annotated relations.

    An unlisted relation counts as false, as in task T1, even if the pair is unobserved. Some data
    sources annotate a relation only where it holds, so rates among observed pairs would be too
    high. With such rates, the validation R-precision falls from .343 to .323 on procthor, and from
    .34 to .10 on bedrooms.

    Raises:
        ValueError: the scenes contain no observed relation.
    """
    V = scenes.v.shape[1]
    related = [scene.evidence for scene in scenes.scenes if scene.evidence.observed.any()]
    if not related:
        raise ValueError(
            f"the {len(scenes)} training scenes contain no observed relation; this baseline needs "
            "annotated relations"
        )
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
    """The relation score log_odds[a, i, j] + g · log(n_i n_j) of relation a from class i to j.

    n_i and n_j are the instance counts of the classes. The score ignores observed relations.

    Attributes:
        log_odds: table over relation, subject class and object class, (relations, classes,
            classes).
        multiplicity: weight g of the instance counts. 0 ignores the counts.
    """

    log_odds: Tensor
    multiplicity: float = 0.0

    def __call__(self, batch: Batch) -> Tensor:
        """Return the log-odds of the relations of a batch, (scenes, relations, n, n).

        n is the number of classes in `batch.classes`. The log-odds of padding are arbitrary.
        """
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
    """Yield a single score: the log-odds of each relation over all pairs of classes."""
    counts = count_triples(train, structure)
    overall = counts.overall().logit()[:, None, None]
    yield {}, TripleTable(overall.expand_as(counts.held))


# Smoothed frequency table p(r | i, j): a strong baseline for relations.
#
# R. Zellers et al., "Neural Motifs: Scene Graph Parsing with Global Context", CVPR 2018, show that
# the labels of subject and object predict most relations. The estimate for a rare pair depends
# mainly on its two classes. The estimate for a rare class depends mainly on p(r):
#
#     p(r | i, j) = (held + s · [p(r | i as subject) + p(r | j as object)] / 2) / (together + s)
#     p(r | i)    = (held with i + m · p(r)) / (pairs with i + m), likewise p(r | j)


_PAIR = (1.0, 3.0, 10.0, 30.0, 100.0)
_END = (3.0, 30.0)
_MULTIPLICITY = (0.0, 0.5, 1.0)


def smoothed_log_odds(counts: TripleCounts, pair: float, end: float) -> Tensor:
    """Return logit p(r | i, j) by the formula above, (relations, classes, classes).

    Args:
        pair: smoothing s of a pair of classes, above 0: number of added cases.
        end: smoothing m of a single class, above 0: number of added cases.
    """
    overall = counts.overall()[:, None]
    subject = (counts.held.sum(2) + end * overall) / (counts.together.sum(1) + end)
    object_ = (counts.held.sum(1) + end * overall) / (counts.together.sum(0) + end)
    back_off = (subject[:, :, None] + object_[:, None, :]) / 2
    return ((counts.held + pair * back_off) / (counts.together + pair)).logit(eps=1e-7)


def frequency_table(train: SceneTensors, structure: Tensor, _seed: int) -> Proposals[RelationScore]:
    """Yield a score for each smoothing of pairs and of classes, and each weight of the counts."""
    counts = count_triples(train, structure)
    for pair in _PAIR:
        for end in _END:
            table = smoothed_log_odds(counts, pair, end)
            for weight in _MULTIPLICITY:
                parameters = {"pair": pair, "end": end, "multiplicity": weight}
                yield parameters, TripleTable(table, weight)


# ComplEx: complex embeddings of classes. Complex numbers allow different scores for left(i, j) and
# left(j, i).
#
# Source: T. Trouillon et al., "Complex Embeddings for Simple Link Prediction", ICML 2016, equation
# 11: logit p(a, i, j) = d_a + Re sum_k S[i,k] R[a,k] conj(S[j,k]). The fit uses all pairs of
# classes that occur in the same scene. The likelihood of a triple is binomial, with `held`
# successes in `together` trials. The penalty is the nuclear 3-norm of T. Lacroix et al., ICML 2018.


_RANKS = (16, 64)
_PENALTIES = (0.03, 0.1, 0.3)
_COMPLEX_MULTIPLICITY = (0.0, 1.0)
_STEPS = 200
_LEARNING_RATE = 0.05


def fit_complex(counts: TripleCounts, *, rank: int, penalty: float, seed: int) -> Tensor:
    """Fit ComplEx, and return the logits of all triples, (relations, classes, classes).

    Args:
        rank: number of complex dimensions of an embedding.
        penalty: weight of the penalty, the mean cubed modulus of the factors of each pair.
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
    cycle = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, _STEPS)
    for _ in range(_STEPS):
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
    """Return the logits d_a + Re <S_i, R_a, conj S_j>, (relations, classes, classes)."""
    turned = classes * relations[:, None]
    # Re(x conj(y)) = Re x Re y + Im x Im y. Two real products are faster than a complex product.
    real = turned.real @ classes.real.T + turned.imag @ classes.imag.T
    return bias[:, None, None] + real


def complex_embedding(
    train: SceneTensors, structure: Tensor, seed: int
) -> Proposals[RelationScore]:
    """Yield a ComplEx score for each rank, penalty and weight of the instance counts."""
    counts = count_triples(train, structure)
    for rank in _RANKS:
        for penalty in _PENALTIES:
            table = fit_complex(counts, rank=rank, penalty=penalty, seed=seed)
            for weight in _COMPLEX_MULTIPLICITY:
                parameters = {"rank": rank, "penalty": penalty, "multiplicity": weight}
                yield parameters, TripleTable(table, weight)


# Frequency table with logical rules: the log-odds change by consequences of observed relations.
#
# The score adds a bonus to a relation a(i, k) that follows by transitivity from observed a(i, j)
# and a(j, k). The score subtracts a penalty from the reverse a(k, i) of each observed or implied
# relation. Canonical relations represent right as left with exchanged subject and object. Bonus and
# penalty are finite, because classes can have several instances, and because annotated on-top is
# not always transitive.
#
# In the batches of task T1b, only the given relations of a scene are marked as observed. This score
# needs such batches.


_CLOSURE_PAIR = (3.0, 10.0, 30.0)
_CLOSURE_END = 30.0
_CLOSURE_MULTIPLICITY = (0.5, 1.0)
_BONUS = (0.0, 1.0, 2.0, 4.0)
_PENALTY = (0.0, 1.0, 3.0)


@dataclass(frozen=True, eq=False)
class ClosureScore:
    """The score of a frequency table, changed by logical rules.

    Attributes:
        table: score without observed relations.
        bonus: value that is added to the log-odds of an implied relation, at least 0.
        penalty: value that is subtracted from the log-odds of the reverse of an observed or implied
            relation, at least 0.
    """

    table: TripleTable
    bonus: float
    penalty: float

    def __call__(self, batch: Batch) -> Tensor:
        """Return log-odds given the observed relations of a batch, (scenes, relations, n, n)."""
        given = (batch.holds > 0) & batch.observed
        closed = transitive_closure(given)
        follows, mirror = closed & ~given, closed.mT & ~closed
        return self.table(batch) + self.bonus * follows - self.penalty * mirror


def frequency_table_with_closure(
    train: SceneTensors, structure: Tensor, _seed: int
) -> Proposals[RelationScore]:
    """Yield a score for each smoothing, weight of the instance counts, bonus and penalty."""
    counts = count_triples(train, structure)
    for pair in _CLOSURE_PAIR:
        log_odds = smoothed_log_odds(counts, pair, _CLOSURE_END)
        for weight in _CLOSURE_MULTIPLICITY:
            table = TripleTable(log_odds, weight)
            for bonus in _BONUS:
                for penalty in _PENALTY:
                    parameters = {"pair": pair, "multiplicity": weight, "bonus": bonus}
                    yield parameters | {"penalty": penalty}, ClosureScore(table, bonus, penalty)


# Baselines for an object of class i at a place (a, j), such as "on-top of the desk". They are the
# frequency table p(i | a, j), and the product of this table and an object score.
#
#     p(i | a, j) = (scenes with a(i, j) + s · p(i | a)) / (scenes with a of any class to j + s)
#
# p(i | a) is smoothed in the same way towards p(i), with m in place of s. There are separate tables
# for i as subject and for i as object. The score of the product is
#
#     score(i | rest) + w · log p(i | a, j) - u · log p(i).
#
# score(i | rest) is the log-odds of i given the other objects of the scene. Both factors depend on
# the class frequency. The last term corrects for this.


_PLACE = (0.3, 1.0, 3.0, 10.0)
_RELATION = (1.0, 10.0)
_WEIGHTS = (0.25, 0.5, 0.75, 1.0)
_CORRECTIONS = (0.0, 0.5, 1.0)


@dataclass(frozen=True, eq=False)
class PlacedTable:
    """The score log p(i | a, j) of class i at the place (a, j), from a frequency table.

    Attributes:
        log_p: table over direction, relation, class j of the place and class i, (2, relations,
            classes, classes). The direction is `Places.outgoing`.
    """

    log_p: Tensor

    def __call__(self, places: Places) -> Tensor:
        """Return log p(i | a, j) of each class i at each place, (places, classes)."""
        return self.log_p[places.outgoing.long(), places.relation, places.anchor]


@dataclass(frozen=True, eq=False)
class PlacedProduct:
    """The product of an object score and a table, as a sum of logs.

    The score is objects(v) + weight · table - correction · log popularity.
    """

    objects: ObjectScore
    table: PlacedTable
    log_popularity: Tensor
    weight: float
    correction: float

    def __call__(self, places: Places) -> Tensor:
        """Return the score of each class at each place, (places, classes)."""
        added = self.weight * self.table(places) - self.correction * self.log_popularity
        return self.objects(places.v) + added


def smoothed_log_p(
    counts: TripleCounts, popularity: Tensor, place: float, relation: float
) -> Tensor:
    """Return log p(i | a, j) in the layout of `PlacedTable.log_p`.

    Args:
        popularity: frequency of each class, (classes,). The function normalises the sum to 1.
        place: smoothing s of a place (a, j), above 0: number of added cases.
        relation: smoothing m of a relation a, above 0: number of added cases.
    """
    # In the second table, the removed class is the subject of the relation. The transpose puts the
    # class j of the place first.
    held = torch.stack([counts.held, counts.held.mT])
    share = popularity / popularity.sum()
    any_anchor = held.sum(2)
    back_off = any_anchor + relation * share
    back_off = back_off / back_off.sum(-1, keepdim=True)
    table = held + place * back_off.unsqueeze(2)
    return (table / (held.sum(-1, keepdim=True) + place)).log()


def placed_table(train: SceneTensors, structure: Tensor, _seed: int) -> Proposals[PlacedScore]:
    """Yield a score for each smoothing s of places and each smoothing m of relations."""
    counts = count_triples(train, structure)
    for place in _PLACE:
        for relation in _RELATION:
            log_p = smoothed_log_p(counts, frequency(train.v), place, relation)
            yield {"place": place, "relation": relation}, PlacedTable(log_p)


def times(
    objects: ObjectScore, table: PlacedTable
) -> Callable[[SceneTensors, Tensor, int], Proposals[PlacedScore]]:
    """Return a generator function for the product of a fitted object score and a fitted table."""

    def placed_table(train: SceneTensors, _structure: Tensor, _seed: int) -> Proposals[PlacedScore]:
        log_popularity = frequency(train.v).log()
        for weight in _WEIGHTS:
            for correction in _CORRECTIONS:
                score = PlacedProduct(objects, table, log_popularity, weight, correction)
                yield {"weight": weight, "correction": correction}, score

    return placed_table
