"""Baselines for relations, supporters and room types from counts of scenes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import product
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Complex, Float, Int
from numpy.typing import NDArray
from scipy.special import expit
from torch import Tensor
from torch.nn.functional import one_hot, softplus

from app.scene import Scene, observe
from app.scene.spatial_relations import SUPPORTS
from training.datasets.batches import Batch, SceneTensors
from training.datasets.cases import scene_of
from training.datasets.moved import has_boxes, posed_scene
from training.evaluation.baselines import (
    Lists,
    TripleCounts,
    count_triples,
    smoothed_log_odds,
    table_score,
    training_lists,
)
from training.evaluation.generation_task import transitive_closure
from training.evaluation.selection import Proposals
from training.evaluation.setting import (
    MisplacedScore,
    Parameters,
    RelationScore,
    RoomScore,
    Structure,
    with_room_type,
)


def relation_popularity(
    train: SceneTensors, structure: Structure, _seed: int
) -> Proposals[RelationScore]:
    """Yield a single score: the log-odds of each relation over all pairs of classes."""
    counts = count_triples(train, structure)
    yield {}, table_score(counts.overall().logit()[:, None, None].expand_as(counts.holds))


# ComplEx: complex embeddings of classes. Complex numbers allow different scores for left(i, j) and
# left(j, i).
#
# Source: T. Trouillon et al., "Complex Embeddings for Simple Link Prediction", ICML 2016, equation
# 11: logit p(a, i, j) = d_a + Re sum_k S[i,k] R[a,k] conj(S[j,k]). The fit uses all pairs of
# classes that occur in the same scene. The likelihood of a triple is binomial, with `holds`
# successes in `together` trials. The penalty is the nuclear 3-norm of T. Lacroix et al., ICML 2018.

_RANKS = (16, 64)
_PENALTIES = (0.03, 0.1, 0.2, 0.3)
_COMPLEX_MULTIPLICITY = (0.0, 0.5, 1.0)
_STEPS = 200
_LEARNING_RATE = 0.05


def fit_complex(
    counts: TripleCounts, *, rank: int, penalty: float, seed: int
) -> Float[Tensor, "A V V"]:
    """Fit ComplEx of `rank` complex dimensions; return the logits of all triples.

    The penalty weighs, for each pair of classes, the mean over the relations of the sum of cubed
    moduli of its factors.
    """
    generator = torch.Generator().manual_seed(seed)
    A, V, _ = counts.holds.shape

    def factors(rows: int, scale: float) -> Complex[Tensor, "rows rank"]:
        values = torch.randn(rows, rank, dtype=torch.cfloat, generator=generator)
        return (scale * values).requires_grad_()

    classes, relations = factors(V, 0.1), factors(A, 1.0)
    bias = counts.overall().logit().requires_grad_()
    i, j = counts.together.nonzero(as_tuple=True)
    trials, successes = counts.together[i, j], counts.holds[:, i, j]
    optimiser = torch.optim.Adam([classes, relations, bias], lr=_LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, _STEPS)
    for _ in range(_STEPS):
        optimiser.zero_grad()
        values = complex_logits(bias, relations, classes)[:, i, j]
        misfit = (trials * softplus(values) - successes * values).sum()
        size = classes.abs() ** 3
        norm = (size[i] + size[j]).sum() + len(i) / A * (relations.abs() ** 3).sum()
        ((misfit + penalty * norm) / len(i)).backward()
        optimiser.step()
        schedule.step()
    with torch.no_grad():
        return complex_logits(bias, relations, classes)


def complex_logits(
    bias: Float[Tensor, " A"],
    relations: Complex[Tensor, "A rank"],
    classes: Complex[Tensor, "V rank"],
) -> Float[Tensor, "A V V"]:
    """Return the logits d_a + Re <S_i, R_a, conj S_j>."""
    turned = classes * relations[:, None]
    # Re(x conj(y)) = Re x Re y + Im x Im y. Two real products are faster than a complex product.
    return bias[:, None, None] + (turned.real @ classes.real.T + turned.imag @ classes.imag.T)


def complex_embedding(
    train: SceneTensors, structure: Structure, seed: int
) -> Proposals[RelationScore]:
    """Yield a ComplEx score for each rank, penalty and weight of the instance counts."""
    counts = count_triples(train, structure)
    for rank, penalty in product(_RANKS, _PENALTIES):
        table = fit_complex(counts, rank=rank, penalty=penalty, seed=seed)
        for weight in _COMPLEX_MULTIPLICITY:
            parameters = {"rank": rank, "penalty": penalty, "multiplicity": weight}
            yield parameters, table_score(table, weight)


# Frequency table with logical rules: the log-odds change by consequences of observed relations.
#
# A relation a(i, k) is implied by transitivity from observed a(i, j) and a(j, k). Its reverse is
# a(k, i). Bonus and penalty are finite, because classes can have several instances, and because
# annotated on-top is not always transitive.
#
# The score needs batches in which only the given relations are observed, as in task T1b.

_CLOSURE_PAIR = (3.0, 10.0, 30.0)
_CLOSURE_CLASS = 30.0
_CLOSURE_MULTIPLICITY = (0.5, 1.0)
_BONUS = (0.0, 1.0, 2.0, 4.0)
_PENALTY = (0.0, 1.0, 3.0)


def closure_score(table: RelationScore, bonus: float, penalty: float) -> RelationScore:
    """Return the score of a table, changed by logical rules.

    Implied relations get the bonus. Reverses of observed or implied relations lose the penalty.
    """

    def score(batch: Batch) -> Float[Tensor, "B A n n"]:
        observed = (batch.holds > 0) & batch.observed
        closed = transitive_closure(observed)
        implied, mirror = closed & ~observed, closed.mT & ~closed
        return table(batch) + bonus * implied - penalty * mirror

    return score


def frequency_table_with_closure(
    train: SceneTensors, structure: Structure, _seed: int
) -> Proposals[RelationScore]:
    """Yield a score for each smoothing, weight of the instance counts, bonus and penalty."""
    counts = count_triples(train, structure)
    for pair in _CLOSURE_PAIR:
        log_odds = smoothed_log_odds(counts, of_pair=pair, of_class=_CLOSURE_CLASS)
        for weight, bonus, penalty in product(_CLOSURE_MULTIPLICITY, _BONUS, _PENALTY):
            parameters = {"pair": pair, "multiplicity": weight, "bonus": bonus, "penalty": penalty}
            yield parameters, closure_score(table_score(log_odds, weight), bonus, penalty)


# Baseline of T3c: a frequency table of supporters, p(supporter class | class).
#
# The supporter of an object is the object that it stands on or in. In scenes with poses, an object
# without supporter has the supporter "nothing". In other scenes, its supporter is unknown.
#
#     suspicion of an object of class i with supporter s = γ log p(s) - log p(s | i)
#     p(s | i) = (n(i, s) + α p(s)) / (n(i) + α)
#
# n(i, s) is the number of objects of class i with supporter s, n(i) their sum over s, and p(s) the
# share of s among all supporters. With several supporters, the least suspicion counts.

_ALPHA: Final = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
_GAMMA: Final = (0.0, 0.25, 0.5, 1.0)


def supporter_score(
    suspicion: Float[NDArray, "V V+1"],  # of class i with supporter s; the last s is "nothing"
    structure: Bool[NDArray, " V"],
) -> MisplacedScore:
    """Return a score with an entry for each object whose supporter is observed, likeliest first."""

    def score(scene: Scene) -> list[dict[str, Any]]:
        entries = [
            {"subject": name, "moved": name, "probability": float(expit(values.min()))}
            for index, object_class, supporters in _supporters(scene, structure)
            for name, values in [(scene.objects[index].id, suspicion[object_class, supporters])]
        ]
        return sorted(entries, key=lambda entry: -entry["probability"])

    return score


def _supporters(
    scene: Scene, structure: Bool[NDArray, " V"]
) -> Iterator[tuple[int, int, Int[NDArray, " supporters"]]]:
    """Yield each object whose supporter is observed, its class, and those of its supporters.

    Structure classes are neither object nor supporter.
    """
    observed = observe(scene)
    classes = np.array([-1 if x.class_index is None else x.class_index for x in scene.objects])
    is_thing = (classes >= 0) & ~structure[classes]
    supports = np.zeros((len(classes), len(classes)), dtype=np.bool_)
    for a, i, j in observed.triples:
        supports[i, j] |= a in SUPPORTS
    for i in np.flatnonzero(is_thing).tolist():
        of_object = np.unique(classes[supports[i] & is_thing])
        if len(of_object):
            yield i, int(classes[i]), of_object
        elif observed.has_boxes or supports[i].any():
            yield i, int(classes[i]), np.array([len(structure)])  # the supporter "nothing"


def supporter_table(
    train: SceneTensors, structure: Structure, _seed: int
) -> Proposals[MisplacedScore]:
    """Yield a score for each smoothing α and weight γ. Relations are needed, else ValueError."""
    if not any(encoded.evidence.observed.any() for encoded in train.scenes):
        raise ValueError(f"the {len(train)} training scenes contain no observed relation")
    is_structure = structure.numpy()
    V = len(is_structure)
    count = np.zeros((V, V + 1))
    for encoded in train.scenes:
        if has_boxes(encoded):
            scene = posed_scene(encoded)
        else:
            triples = [(int(a), int(i), int(j)) for a, i, j in np.argwhere(encoded.instance_holds)]
            scene = scene_of(encoded, range(len(encoded.instance_classes)), triples)
        for _, object_class, supporters in _supporters(scene, is_structure):
            count[object_class, supporters] += encoded.weight
    prior = (count.sum(0) + 0.5) / (count.sum() + 0.5 * (V + 1))
    for alpha in _ALPHA:
        p = (count + alpha * prior) / (count.sum(1, keepdims=True) + alpha)
        for gamma in _GAMMA:
            suspicion = gamma * np.log(prior) - np.log(p)
            yield {"alpha": alpha, "gamma": gamma}, supporter_score(suspicion, is_structure)


# Naive Bayes over room types:
#
#     log p(t | v) = log p(t) + s · sum_j log p(v_j | t) + constant
#     p(v_j = 1 | t) = (scenes of t with j + α · p(j)) / (scenes of t + α)
#
# The sum runs over the listed classes, or over all classes. Classes that often occur together are
# no independent evidence. A factor s < 1 corrects for this. If the request names its data source,
# all counts are those of this source alone, with another α.

_ROOM_ALPHA = (10.0, 30.0, 100.0, 300.0)
_SOURCE_ALPHA = (1.0, 3.0, 10.0)
_ROOM_EXPONENTS = (0.5, 0.75)


class _RoomCounts(NamedTuple):
    """Weighted counts of the scenes of each room type: all, with a class, and labelled."""

    scenes: Float[Tensor, " C"]
    present: Float[Tensor, "C V"]
    labelled: Float[Tensor, "C V"]

    @classmethod
    def of(cls, lists: Lists, room: Int[Tensor, " scenes"], types: int) -> _RoomCounts:
        """Count lists whose scenes have these room types."""
        member = one_hot(room, types).float().T * lists.weight
        return cls(member.sum(1), member @ lists.v, member @ lists.labelled.float())

    def table(
        self, alpha: float, exponent: float, absent: bool
    ) -> tuple[Float[Tensor, " C"], Float[Tensor, "C V"]]:
        """Return biases and weights of naive Bayes; with `absent`, absent classes are evidence."""
        average = (self.present.sum(0) + 0.5) / (self.labelled.sum(0) + 1.0)  # p(j)
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


def _room_counts(
    train: SceneTensors, structure: Structure
) -> Iterator[tuple[str, dict[str, _RoomCounts]]]:
    """Yield each set of scenes with its counts for all data sources, and for each data source."""
    scenes = with_room_type(train)
    if not len(scenes):
        raise ValueError("no training scene has a room type")
    types = int(scenes.room.max()) + 1
    for name, lists in training_lists(scenes, structure):
        room, source = scenes.room[lists.index], scenes.source[lists.index]
        counts = {"": _RoomCounts.of(lists, room, types)}
        for k in source.unique().tolist():
            own = Lists(*(values[source == k] for values in vars(lists).values()))
            counts[scenes.source_names[k]] = _RoomCounts.of(own, room[source == k], types)
        yield name, counts


def room_naive_bayes(train: SceneTensors, structure: Structure, _seed: int) -> Proposals[RoomScore]:
    """Yield a score for each set of scenes, smoothing, kind of evidence and exponent."""
    grid = tuple(product(_ROOM_ALPHA, _SOURCE_ALPHA, (False, True), _ROOM_EXPONENTS))
    for name, counts in _room_counts(train, structure):
        for alpha, source_alpha, absent, s in grid:
            tables = {
                source: count.table(source_alpha if source else alpha, s, absent)
                for source, count in counts.items()
            }
            kind: Parameters = {"scenes": name, "absent": absent, "exponent": s}
            yield {**kind, "alpha": alpha, "source_alpha": source_alpha}, room_table(tables)


def most_common_room(train: SceneTensors, structure: Structure, _seed: int) -> Proposals[RoomScore]:
    """Yield the frequencies of the room types for each set of scenes."""
    for name, counts in _room_counts(train, structure):
        yield {"scenes": name}, room_table({q: c.table(1.0, 0.0, False) for q, c in counts.items()})
