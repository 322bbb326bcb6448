"""ComplEx: relations between embedded classes, complex so that left differs from right.

T. Trouillon et al., "Complex Embeddings for Simple Link Prediction", ICML 2016, equation 11:
logit p(a, i, j) = d_a + Re sum_k S[i,k] R[a,k] conj(S[j,k]), fitted to all pairs of classes seen
together as binomials (held of together), with the nuclear 3-norm of T. Lacroix et al., ICML 2018,
as penalty.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import softplus

from training.baselines.fitting import Proposals
from training.baselines.triple_counts import TripleCounts, TripleTable, count_triples
from training.batches import SceneTensors
from training.evaluation.relations import RelationScore

_RANKS = (16, 64)
_PENALTIES = (0.03, 0.1, 0.3)
_MULTIPLICITY = (0.0, 1.0)
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


def propose(train: SceneTensors, structure: Tensor, seed: int) -> Proposals[RelationScore]:
    """Ranks × penalties × weight of the instance counts."""
    counts = count_triples(train, structure)
    for rank in _RANKS:
        for penalty in _PENALTIES:
            table = fit_complex(counts, rank=rank, penalty=penalty, seed=seed)
            for weight in _MULTIPLICITY:
                parameters = {"rank": rank, "penalty": penalty, "multiplicity": weight}
                yield parameters, TripleTable(table, weight)
