"""Baselines that score relations between classes, and classes at a place, by counts of triples."""

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

# How often each relation held between each pair of classes, and tables of that size.


@dataclass(frozen=True, eq=False)
class TripleCounts:
    """Scenes per (a, i, j); nothing is counted of structure classes and of i = j.

    Attributes:
        held: (A, V, V) scenes in which the relation held.
        together: (V, V) scenes with annotated relations in which both classes were present.
    """

    held: Tensor
    together: Tensor

    def overall(self) -> Tensor:
        """p(r) of a pair of classes, (A,); one case is added to both sides."""
        return (self.held.sum((1, 2)) + 1.0) / (self.together.sum() + 2.0)


def count_triples(scenes: SceneTensors, structure: Tensor) -> TripleCounts:
    """Counts over the scenes with annotated relations.

    What is not listed counts as off, as T1 counts it, even where the geometry left a pair
    unobserved: rates among observed pairs alone overrate relations that are looked for only where
    they hold (validation R-precision .323 against .343 on procthor, .10 against .34 on bedrooms).

    Raises:
        ValueError: no scene has any.
    """
    V = scenes.v.shape[1]
    related = [scene.evidence for scene in scenes.scenes if scene.evidence.observed.any()]
    if not related:
        raise ValueError(f"no relation was observed in {len(scenes)} training scenes")
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
    """A relation score that is looked up: table[a, i, j] + g · log(n_i n_j).

    It reads the classes and counts of a batch, never its relations.

    Attributes:
        log_odds: (A, V, V).
        multiplicity: g, what more instances at either end add; 0 ignores counts.
    """

    log_odds: Tensor
    multiplicity: float = 0.0

    def __call__(self, batch: Batch) -> Tensor:
        """Log-odds (B, A, n, n), of no meaning where padded."""
        index = batch.classes.clamp(min=0)
        values = self.log_odds[:, index[:, :, None], index[:, None, :]].movedim(0, 1)
        if self.multiplicity:
            logs = batch.counts.clamp(min=1).to(values.dtype).log()
            values = values + self.multiplicity * (logs[:, None, :, None] + logs[:, None, None, :])
        return values


# How often each relation holds at all, whatever its ends.


def relation_popularity(
    train: SceneTensors, structure: Tensor, _seed: int
) -> Proposals[RelationScore]:
    """One proposal: nothing to tune."""
    counts = count_triples(train, structure)
    overall = counts.overall().logit()[:, None, None]
    yield {}, TripleTable(overall.expand_as(counts.held))


# Smoothed frequency table p(r | i, j): the strong baseline for relations.
#
# R. Zellers et al., "Neural Motifs: Scene Graph Parsing with Global Context", CVPR 2018: the labels
# of the two ends predict most relations. A pair seen rarely falls back on its ends, an end seen
# rarely on p(r):
#
#     p(r | i, j) = (held + s · [p(r | i as subject) + p(r | j as object)] / 2) / (together + s)
#     p(r | i)    = (held with i + m · p(r)) / (pairs with i + m), likewise p(r | j)


_PAIR = (1.0, 3.0, 10.0, 30.0, 100.0)
_END = (3.0, 30.0)
_MULTIPLICITY = (0.0, 0.5, 1.0)


def smoothed_log_odds(counts: TripleCounts, pair: float, end: float) -> Tensor:
    """logit p(r | i, j), (A, V, V).

    Args:
        pair: s > 0, cases of back-off added to a pair.
        end: m > 0, cases of p(r) added to an end.
    """
    overall = counts.overall()[:, None]
    subject = (counts.held.sum(2) + end * overall) / (counts.together.sum(1) + end)
    object_ = (counts.held.sum(1) + end * overall) / (counts.together.sum(0) + end)
    back_off = (subject[:, :, None] + object_[:, None, :]) / 2
    return ((counts.held + pair * back_off) / (counts.together + pair)).logit(eps=1e-7)


def frequency_table(train: SceneTensors, structure: Tensor, _seed: int) -> Proposals[RelationScore]:
    """Smoothing of pairs × of ends × weight of the instance counts.

    The weight moves nothing where counts are withheld (all 1).
    """
    counts = count_triples(train, structure)
    for pair in _PAIR:
        for end in _END:
            table = smoothed_log_odds(counts, pair, end)
            for weight in _MULTIPLICITY:
                parameters = {"pair": pair, "end": end, "multiplicity": weight}
                yield parameters, TripleTable(table, weight)


# ComplEx: relations between embedded classes, complex so that left differs from right.
#
# T. Trouillon et al., "Complex Embeddings for Simple Link Prediction", ICML 2016, equation 11:
# logit p(a, i, j) = d_a + Re sum_k S[i,k] R[a,k] conj(S[j,k]), fitted to all pairs of classes seen
# together as binomials (held of together), with the nuclear 3-norm of T. Lacroix et al., ICML 2018,
# as penalty.


_RANKS = (16, 64)
_PENALTIES = (0.03, 0.1, 0.3)
_COMPLEX_MULTIPLICITY = (0.0, 1.0)
_STEPS = 200
_LEARNING_RATE = 0.05


def fit_complex(
    counts: TripleCounts, *, rank: int, penalty: float, seed: int, steps: int = _STEPS
) -> Tensor:
    """Logits (A, V, V) of the fitted model.

    Args:
        rank: complex dimensions.
        penalty: weight of the mean cubed modulus of the factors of each pair.
        steps: of Adam, each over all pairs, its rate falling to 0.
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
    """d_a + Re <S_i, R_a, conj S_j> for bias (A,), relations (A, K) and classes (V, K)."""
    turned = classes * relations[:, None]
    # Re(x conj(y)) = Re x Re y + Im x Im y: real products are the faster ones.
    real = turned.real @ classes.real.T + turned.imag @ classes.imag.T
    return bias[:, None, None] + real


def complex_embedding(
    train: SceneTensors, structure: Tensor, seed: int
) -> Proposals[RelationScore]:
    """Ranks × penalties × weight of the instance counts."""
    counts = count_triples(train, structure)
    for rank in _RANKS:
        for penalty in _PENALTIES:
            table = fit_complex(counts, rank=rank, penalty=penalty, seed=seed)
            for weight in _COMPLEX_MULTIPLICITY:
                parameters = {"rank": rank, "penalty": penalty, "multiplicity": weight}
                yield parameters, TripleTable(table, weight)


# Completion by logic: the frequency table, moved by what follows from the given relations.
#
# What a chain of given a(i, j), a(j, k) leads to follows transitively and gets a bonus; the mirror
# image a(k, i) of what is given or follows gets a penalty. (That right is left read from the other
# end, the inverse closure, is built into the canonical relations.) Both are soft: between classes
# with several instances neither rule is strict, and on-top is no order among annotated supports.
#
# The score reads `holds` where `observed`, as GIVEN evidence: it must be handed a batch that marks
# the given relations alone, as T1b does, never a scene's own
# annotation.


_CLOSURE_PAIR = (3.0, 10.0, 30.0)
_CLOSURE_END = 30.0
_CLOSURE_MULTIPLICITY = (0.5, 1.0)
_BONUS = (0.0, 1.0, 2.0, 4.0)
_PENALTY = (0.0, 1.0, 3.0)


@dataclass(frozen=True, eq=False)
class ClosureScore:
    """table + bonus · [follows] - penalty · [mirror of given or following].

    Attributes:
        table: log-odds without evidence.
        bonus, penalty: in log-odds, >= 0.
    """

    table: TripleTable
    bonus: float
    penalty: float

    def __call__(self, batch: Batch) -> Tensor:
        """Log-odds (B, A, n, n) given the observed relations of the batch."""
        given = (batch.holds > 0) & batch.observed
        closed = transitive_closure(given)
        follows, mirror = closed & ~given, closed.mT & ~closed
        return self.table(batch) + self.bonus * follows - self.penalty * mirror


def frequency_table_with_closure(
    train: SceneTensors, structure: Tensor, _seed: int
) -> Proposals[RelationScore]:
    """Smoothing × weight of the counts × bonus × penalty."""
    counts = count_triples(train, structure)
    for pair in _CLOSURE_PAIR:
        log_odds = smoothed_log_odds(counts, pair, _CLOSURE_END)
        for weight in _CLOSURE_MULTIPLICITY:
            table = TripleTable(log_odds, weight)
            for bonus in _BONUS:
                for penalty in _PENALTY:
                    parameters = {"pair": pair, "multiplicity": weight, "bonus": bonus}
                    yield parameters | {"penalty": penalty}, ClosureScore(table, bonus, penalty)


# Something on the desk: frequency table p(i | a, j), alone and times an object score.
#
#     p(i | a, j) = (held + s · p(i | a)) / (held by any + s),   p(i | a) likewise on p(i) with m
#
# separately for i as subject and as object. The product adds log-odds of what else is in the scene,
#
#     score(i | rest) + w · log p(i | a, j) - u · log p(i),
#
# where the last term takes out a popularity that both factors hold.


_PLACE = (0.3, 1.0, 3.0, 10.0)
_RELATION = (1.0, 10.0)
_WEIGHTS = (0.25, 0.5, 0.75, 1.0)
_CORRECTIONS = (0.0, 0.5, 1.0)


@dataclass(frozen=True, eq=False)
class PlacedTable:
    """The score: log_p (2, A, V, V), by outgoing, relation, anchor and missing class."""

    log_p: Tensor

    def __call__(self, places: Places) -> Tensor:
        """log p(i | a, j), (B, V)."""
        return self.log_p[places.outgoing.long(), places.relation, places.anchor]


@dataclass(frozen=True, eq=False)
class PlacedProduct:
    """The score: objects(v) + weight · table - correction · log popularity (V,)."""

    objects: ObjectScore
    table: PlacedTable
    log_popularity: Tensor
    weight: float
    correction: float

    def __call__(self, places: Places) -> Tensor:
        """Scores (B, V)."""
        added = self.weight * self.table(places) - self.correction * self.log_popularity
        return self.objects(places.v) + added


def smoothed_log_p(
    counts: TripleCounts, popularity: Tensor, place: float, relation: float
) -> Tensor:
    """log p(i | a, j), (2, A, V, V) as in `PlacedTable`.

    Args:
        popularity: p(i), (V,), need not sum to 1.
        place: s > 0, cases of p(i | a) added to each (a, j).
        relation: m > 0, cases of p(i) added to each a.
    """
    # Index 1: the missing class is the subject, so that the anchor comes last in `held`.
    held = torch.stack([counts.held, counts.held.mT])
    share = popularity / popularity.sum()
    any_anchor = held.sum(2)
    back_off = any_anchor + relation * share
    back_off = back_off / back_off.sum(-1, keepdim=True)
    table = held + place * back_off.unsqueeze(2)
    return (table / (held.sum(-1, keepdim=True) + place)).log()


def placed_table(train: SceneTensors, structure: Tensor, _seed: int) -> Proposals[PlacedScore]:
    """Smoothing of places × of relations."""
    counts = count_triples(train, structure)
    for place in _PLACE:
        for relation in _RELATION:
            log_p = smoothed_log_p(counts, frequency(train.v), place, relation)
            yield {"place": place, "relation": relation}, PlacedTable(log_p)


def times(
    objects: ObjectScore, table: PlacedTable
) -> Callable[[SceneTensors, Tensor, int], Proposals[PlacedScore]]:
    """Proposals for the product of a fitted object score and a fitted table."""

    def placed_table(train: SceneTensors, _structure: Tensor, _seed: int) -> Proposals[PlacedScore]:
        log_popularity = frequency(train.v).log()
        for weight in _WEIGHTS:
            for correction in _CORRECTIONS:
                score = PlacedProduct(objects, table, log_popularity, weight, correction)
                yield {"weight": weight, "correction": correction}, score

    return placed_table
