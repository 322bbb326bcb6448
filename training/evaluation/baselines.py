"""The baselines of comparisons and of the gate; `training.research.baselines` has further ones.

Baselines for objects are class frequencies and EASE. They learn from the same scenes as a machine:
with its weights of scenes, without structure, and without classes that a data source cannot show.
They are selected by the same `validation_score`. Baselines for relations, and for objects at a
place, count triples.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from training.datasets.batches import Batch, SceneTensors
from training.evaluation.selection import AT_PLACE, RELATIONS, Baseline, Proposals
from training.evaluation.setting import Model, ObjectScore, PlacedScore, RelationScore, Structure


@dataclass(frozen=True, eq=False)
class LinearScore:
    """The linear score bias + v · weights of each class.

    Rows of the weights are present classes, columns are scored classes. The diagonal is zero.
    """

    bias: Float[Tensor, " V"]
    weights: Float[Tensor, "V V"]

    @property
    def parameter_count(self) -> int:
        """Number of biases and of weights that are not zero."""
        return len(self.bias) + int(self.weights.count_nonzero())

    def __call__(self, v: Float[Tensor, "B V"]) -> Float[Tensor, "B V"]:
        """Return the score of each class for the presence of classes."""
        return self.bias + v @ self.weights


@dataclass(frozen=True, eq=False)
class Lists:
    """Training scenes as the object part of a machine learns from them."""

    v: Float[Tensor, "scenes V"]  # without structure classes
    labelled: Bool[Tensor, "scenes V"]  # False for classes that the data source cannot show
    weight: Float[Tensor, " scenes"]  # 1 in the mean
    index: Int[Tensor, " scenes"]  # in training

    def frequency(self) -> Float[Tensor, " V"]:
        """Return the share of scenes with each class among the labelled scenes."""
        return frequency(self.v, self.weight, self.labelled)

    def filled(self) -> Float[Tensor, "scenes V"]:
        """Return the presence with unlabelled entries replaced by the frequency of the class."""
        return torch.where(self.labelled, self.v, self.frequency())


def training_lists(train: SceneTensors, structure: Structure) -> Iterator[tuple[str, Lists]]:
    """Yield sets of training scenes with their names. A baseline chooses between the sets.

    A set has all scenes, or only those with complete object lists. A class that a data source
    cannot show is unlabelled, or it is absent.
    """
    shown = train.annotated_classes[train.source] & ~structure
    v, weight = train.v * ~structure, train.weight
    every = torch.ones_like(train.complete)
    for suffix, labelled in (("", shown | (v > 0)), (", unlisted absent", ~structure.expand_as(v))):
        for name, mask in (("all", every), ("complete", train.complete)):
            # Leave out a set that equals an earlier one.
            is_new = name == "all" or not mask.all()
            if mask.any() and is_new and not (suffix and shown[mask].all(0)[~structure].all()):
                relative_weight = weight[mask] / weight[mask].mean()
                index = mask.nonzero().squeeze(1)
                yield name + suffix, Lists(v[mask], labelled[mask], relative_weight, index)


def frequency(
    v: Float[Tensor, "scenes V"],
    weight: Float[Tensor, " scenes"] | None = None,
    labelled: Bool[Tensor, "scenes V"] | None = None,
) -> Float[Tensor, " V"]:
    """Return the share of scenes with each class, smoothed by 1/2 in both counts."""
    weight = torch.ones(len(v)) if weight is None else weight
    total = weight.sum().expand(v.shape[1])
    if labelled is not None:
        of_labelled = weight @ labelled.to(v.dtype)
        total = torch.where(of_labelled > 0, of_labelled, total)
    return (weight @ v + 0.5) / (total + 1.0)


def popularity(train: SceneTensors, structure: Structure, _seed: int) -> Proposals[ObjectScore]:
    """Yield the log-odds of the class frequencies."""
    V = train.v.shape[1]
    for name, lists in training_lists(train, structure):
        yield {"scenes": name}, LinearScore(lists.frequency().logit(), torch.zeros(V, V))


_EASE_L2 = (3.0, 10.0, 30.0, 50.0, 100.0, 300.0)


def fit_ease(
    v: Float[Tensor, "scenes V"], l2: float, weight: Float[Tensor, " scenes"] | None = None
) -> LinearScore:
    """Fit EASE, a ridge regression of every class on all other classes with a free intercept.

    Source: Steck, "Embarrassingly Shallow Autoencoders for Sparse Data", WWW 2019, equation 8. With
    the centred presence X and P = (X'X + λI)⁻¹, the least-squares weights with zero diagonal are
    -P[j,i] / P[i,i]. `weight` weighs the squared errors of each scene.
    """
    w = torch.ones(len(v)) if weight is None else weight
    presence, w = v.double(), w.double()
    mean = w @ presence / w.sum()
    centred = presence - mean
    gram = (centred * w.unsqueeze(1)).T @ centred  # X'X
    gram.diagonal().add_(l2)
    precision = torch.linalg.inv(gram)
    weights = (-precision / precision.diagonal()).fill_diagonal_(0.0)
    return LinearScore((mean - mean @ weights).float(), weights.float())


def ease(train: SceneTensors, structure: Structure, _seed: int) -> Proposals[ObjectScore]:
    """Yield a score for each ridge penalty. Unlabelled classes have their mean."""
    for name, lists in training_lists(train, structure):
        v = lists.filled()
        for l2 in _EASE_L2:
            yield {"scenes": name, "l2": l2}, fit_ease(v, l2, lists.weight)


@dataclass(frozen=True, eq=False)
class TripleCounts:
    """Numbers of scenes with annotated relations; 0 for structure, and for equal classes."""

    holds: Float[Tensor, "A V V"]  # scenes in which a relation holds
    together: Float[Tensor, "V V"]  # scenes that contain both classes

    def overall(self) -> Float[Tensor, " A"]:
        """Return the add-one smoothed probability of each relation over all pairs."""
        return (self.holds.sum((1, 2)) + 1.0) / (self.together.sum() + 2.0)


def count_triples(scenes: SceneTensors, structure: Structure) -> TripleCounts:
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
    holds = np.zeros((A, V, V), dtype=np.float32)
    together = np.zeros((V, V), dtype=np.float32)
    for evidence in related:
        holds[np.ix_(np.arange(A), evidence.classes, evidence.classes)] += evidence.holds
        together[np.ix_(evidence.classes, evidence.classes)] += 1.0
    is_structure = structure.numpy()
    counted = ~(is_structure[:, None] | is_structure | np.eye(V, dtype=np.bool_))
    return TripleCounts(torch.from_numpy(holds * counted), torch.from_numpy(together * counted))


def table_score(log_odds: Float[Tensor, "A V V"], multiplicity: float = 0.0) -> RelationScore:
    """Return the relation score log_odds[a, i, j] + multiplicity · log(n_i n_j).

    n_i and n_j are the instance counts. The score ignores observed relations.
    """

    def score(batch: Batch) -> Float[Tensor, "B A n n"]:
        index = batch.classes.clamp(min=0)
        values = log_odds[:, index[:, :, None], index[:, None, :]].movedim(0, 1)
        if multiplicity:
            logs = batch.counts.clamp(min=1).to(values.dtype).log()
            values = values + multiplicity * (logs[:, None, :, None] + logs[:, None, None, :])
        return values

    return score


_PAIR = (1.0, 3.0, 10.0, 30.0, 100.0)
_CLASS = (3.0, 30.0)
_MULTIPLICITY = (0.0, 0.5, 1.0)


def smoothed_log_odds(
    counts: TripleCounts, *, of_pair: float, of_class: float
) -> Float[Tensor, "A V V"]:
    """Return logit p(r | i, j).

    The estimate for a rare pair depends mainly on its two classes, as labels predict most relations
    (Zellers et al., "Neural Motifs: Scene Graph Parsing with Global Context", CVPR 2018). That for
    a rare class depends mainly on p(r):

        p(r | i, j) = (holds + s · [p(r | i as subject) + p(r | j as object)] / 2) / (together + s)
        p(r | i)    = (holds with i + m · p(r)) / (pairs with i + m), likewise p(r | j)

    s (`of_pair`) and m (`of_class`) are numbers of added cases, above 0.
    """
    added = of_class * counts.overall()[:, None]
    subject = (counts.holds.sum(2) + added) / (counts.together.sum(1) + of_class)
    object_ = (counts.holds.sum(1) + added) / (counts.together.sum(0) + of_class)
    back_off = (subject[:, :, None] + object_[:, None, :]) / 2
    return ((counts.holds + of_pair * back_off) / (counts.together + of_pair)).logit(eps=1e-7)


def frequency_table(
    train: SceneTensors, structure: Structure, _seed: int
) -> Proposals[RelationScore]:
    """Yield a score for each smoothing of pairs and of classes, and each weight of the counts."""
    counts = count_triples(train, structure)
    for of_pair, of_class in product(_PAIR, _CLASS):
        table = smoothed_log_odds(counts, of_pair=of_pair, of_class=of_class)
        for weight in _MULTIPLICITY:
            parameters = {"pair": of_pair, "class": of_class, "multiplicity": weight}
            yield parameters, table_score(table, weight)


_PLACE = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
_RELATION = (0.3, 1.0, 3.0, 10.0)
_WEIGHTS = (0.25, 0.5, 0.75, 1.0, 1.25, 1.5)
_CORRECTIONS = (0.0, 0.25, 0.5, 1.0)


def place_score(log_p: Float[Tensor, "2 A V V"]) -> PlacedScore:
    """Return the score log p(i | a, j) of a table over `outgoing`, relation a, class j, class i."""
    return lambda places: log_p[places.outgoing.long(), places.relation, places.anchor]


def smoothed_log_p(
    counts: TripleCounts, popularity: Float[Tensor, " V"], place: float, relation: float
) -> Float[Tensor, "2 A V V"]:
    """Return log p(i | a, j) in the layout of `place_score`.

        p(i | a, j) = (scenes with a(i, j) + s · p(i | a)) / (scenes with a of any class to j + s)

    p(i | a) is smoothed in the same way towards p(i), with m in place of s. p(i) is proportional to
    the popularity. s (`place`) and m (`relation`) are numbers of added cases.
    """
    # The second table is of outgoing places. The transpose puts the class j of the place first.
    holds = torch.stack([counts.holds, counts.holds.mT])
    share = popularity / popularity.sum()
    back_off = holds.sum(2) + relation * share
    back_off = back_off / back_off.sum(-1, keepdim=True)
    table = holds + place * back_off.unsqueeze(2)
    return (table / (holds.sum(-1, keepdim=True) + place)).log()


def placed_table(train: SceneTensors, structure: Structure, _seed: int) -> Proposals[PlacedScore]:
    """Yield a score for each smoothing s of places and each smoothing m of relations."""
    counts = count_triples(train, structure)
    for place, relation in product(_PLACE, _RELATION):
        log_p = smoothed_log_p(counts, frequency(train.v), place, relation)
        yield {"place": place, "relation": relation}, place_score(log_p)


POPULARITY: Final = Baseline("popularity", popularity)
EASE: Final = Baseline("EASE", ease)
FREQUENCY_TABLE: Final = Baseline("frequency table", frequency_table, RELATIONS)
PLACED: Final = Baseline("frequency table p(i | a, j)", placed_table, AT_PLACE)


def placed_product(name: str, objects: Model, table: Model) -> Baseline:
    """Return the baseline of T2-at that multiplies a score of missing objects by `PLACED`.

    Its score is objects(v) + weight · table - correction · log popularity.

    Raises:
        ValueError: a score is missing.
    """
    missing, at_place = objects.missing, table.at_place
    if missing is None or at_place is None:
        raise ValueError("the product needs an object score and a table of places")

    def product_score(
        weight: float, correction: float, log_popularity: Float[Tensor, " V"]
    ) -> PlacedScore:
        # Both factors depend on the class frequency, so the correction subtracts it.
        return lambda places: (
            missing(places.v) + (weight * at_place(places) - correction * log_popularity)
        )

    def propose(train: SceneTensors, _structure: Structure, _seed: int) -> Proposals[PlacedScore]:
        log_popularity = frequency(train.v, train.weight).log()
        for weight, correction in product(_WEIGHTS, _CORRECTIONS):
            score = product_score(weight, correction, log_popularity)
            yield {"weight": weight, "correction": correction}, score

    return Baseline(f"{PLACED.name} × {name}", propose, AT_PLACE)
