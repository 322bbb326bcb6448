"""RBM, GBM and Triway of Bozcan et al. (2018): energies, Gibbs sweeps and training.

The units are binary: objects v (V,), relations r (T,), context h1 (H1,) and h2 (H2,). H2 is 0 in a
machine of one hidden layer. Unit e of r is a triple (relation, subject class i, object class j) of
the training scenes. The other triples have no unit: they are off with probability one.

    E(v, r, h1, h2) = - b·v - c1·h1 - c2·h2 - v'W h1 - h1'J h2 - sum_e r_e g_e l_e(v, h1)

    RBM     l_e = d_e + U_e·h1                          g_e = 1
    GBM     l_e = d_e + U_e·h1 + g_e1 v_i + g_e2 v_j    g_e = 1
    Triway  l_e = d_e + U_e·h1                          g_e = v_i v_j, the gate

A sweep samples the context, the objects given context and relations, and then the relations given
context and objects, as the paper does. The log-odds of object i are -E(v_i = 1) + E(v_i = 0) at the
current values of all other units. All objects are sampled in one block.

Three choices:

- The published code multiplies only the tri-way weight by v_i v_j, and not U. Here the gate covers
  both, and a sampled relation of an absent object is off.
- So the sweep of the Triway is no exact Gibbs sampler. An exact sampler of r_e <= v_i v_j holds all
  objects of relations that are on. The objects of listed relations then have no gradient in CD-1.
- Each triple has free weights d_e and U_e, as in the later code of the authors. The paper shares
  one weight among all triples of a relation and adds up their gradients, which diverges.

The machines are trained by contrastive divergence, with early stopping. The positive phase samples
the context given the scene. The negative phase samples objects given context and relations, and
then relations given context and objects, at temperature 1. A step adds
.5 (<-dE/dw>_positive - <-dE/dw>_negative) to each weight w. Both phases sample their last context
with the same random numbers, so most of the noise cancels. An unlisted relation of an annotated
scene is false. The relations of a scene without annotation occur in neither phase.

The error E of the paper is the squared difference between the probabilities at the start of the
positive phase (0 or 1) and at the end of the negative phase, summed over units and averaged over
scenes. Training stops if the validation error, objects plus relations, has not fallen for
`PATIENCE` epochs, and the weights of the best epoch are kept.

Sources: Hinton, "Training products of experts by minimizing contrastive divergence" (2002);
Bozcan et al. (2018).
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from training.seed.scenes import Material, Scenes

_SCALE: Final = 0.01  # standard deviation of the initial weights
_ROUNDS: Final = 5  # sweeps over two hidden layers, given the visible units


Objects: TypeAlias = Float[Tensor, "B V"]  # values of units, logits or probabilities
Relations: TypeAlias = Float[Tensor, "B T"]
H1Units: TypeAlias = Float[Tensor, "B H1"]
H2Units: TypeAlias = Float[Tensor, "B H2"]


@dataclass(frozen=True, eq=False)
class State:
    """Values of all units of B scenes."""

    v: Objects
    r: Relations
    h1: H1Units
    h2: H2Units


@dataclass(frozen=True, eq=False)
class Free:
    """True for the units that a sweep samples. The other units keep their values."""

    v: Bool[Tensor, "B V"]
    r: Bool[Tensor, "B T"]

    @classmethod
    def of(cls, v: Objects, annotated: Bool[Tensor, "B"], r: Relations) -> Free:
        """Return all objects, and the relations of the `annotated` scenes."""
        return cls(torch.ones_like(v).bool(), annotated.unsqueeze(1).expand(r.shape))


def bernoulli(p: Float[Tensor, "*s"], generator: torch.Generator) -> Float[Tensor, "*s"]:
    """Sample units that are on with probability p."""
    return (torch.rand(p.shape, generator=generator, dtype=p.dtype) < p).to(p.dtype)


class Machine(nn.Module):
    """The parts that all machines share. A subclass defines its relations and their effect."""

    def __init__(
        self, triples: Int[Tensor, "T 3"], V: int, H1: int, H2: int, generator: torch.Generator
    ) -> None:
        """Draw small random weight matrices. Biases start at 0; the T triples are the relations."""
        super().__init__()
        T = len(triples)
        self.subject, self.object = triples[:, 1], triples[:, 2]

        def weights(*shape: int) -> nn.Parameter:
            return _fixed(_SCALE * torch.randn(shape, generator=generator))

        self.b, self.c1, self.c2 = (_fixed(torch.zeros(n)) for n in (V, H1, H2))
        self.W, self.J = weights(V, H1), weights(H1, H2)
        self.d, self.U = _fixed(torch.zeros(T)), weights(T, H1)

    def update(self, positive: State, negative: State, rate: float) -> None:
        """Add rate * (<-dE/dw>_positive - <-dE/dw>_negative) to each weight; means over scenes."""
        for state, step in ((positive, rate), (negative, -rate)):
            self.add_products(state, step / len(state.v))

    def add_products(self, state: State, step: float) -> None:
        """Add step * -dE/dw, a product of units, summed over scenes, to each weight w."""
        v, r, h1, h2 = state.v, state.r, state.h1, state.h2
        for bias, units in ((self.b, v), (self.c1, h1), (self.c2, h2), (self.d, r)):
            bias.add_(units.sum(0), alpha=step)
        for weights, rows, columns in ((self.W, v, h1), (self.J, h1, h2), (self.U, r, h1)):
            weights.addmm_(rows.T, columns, alpha=step)

    def gate(self, v: Objects) -> Relations:
        """Return 1 for each relation that can be on given the objects."""
        return v.new_ones(len(v), len(self.d))

    def relation_logits(self, v: Objects, h1: H1Units) -> Relations:
        """Return l_e, the log-odds of each relation whose gate is 1."""
        return self.d + h1 @ self.U.T

    def h1_logits(self, v: Objects, r: Relations, h2: H2Units) -> H1Units:
        """Return the log-odds of h1 given all other units."""
        return self.c1 + v @ self.W + r @ self.U + h2 @ self.J.T

    def h2_logits(self, h1: H1Units) -> H2Units:
        """Return the log-odds of h2 given h1."""
        return self.c2 + h1 @ self.J

    def sample_objects(
        self, state: State, free: Free, temperature: float, generator: torch.Generator
    ) -> tuple[Objects, Objects]:
        """Sample the free objects given h1 and r. Return v and p(v_i = 1)."""
        p = ((self.b + state.h1 @ self.W.T + self.relation_field(state)) / temperature).sigmoid()
        return torch.where(free.v, bernoulli(p, generator), state.v), p

    def relation_field(self, state: State) -> Objects:
        """Return the effect of the relations on the log-odds of objects."""
        return torch.zeros_like(state.v)

    def presence(self, v: Objects) -> tuple[Relations, Relations]:
        """Return the presence of the subject and of the object of each relation."""
        return v.index_select(1, self.subject), v.index_select(1, self.object)

    def sum_by_class(self, subject: Relations, object_: Relations) -> Objects:
        """Sum values of the relations over their subject classes and over their object classes."""
        total = subject.new_zeros(len(subject), len(self.b)).index_add(1, self.subject, subject)
        return total.index_add(1, self.object, object_)

    def hidden(
        self, v: Objects, r: Relations, generator: torch.Generator
    ) -> tuple[H1Units, H2Units]:
        """Sample h1 and h2 given the visible units. Exact with one layer, else `_ROUNDS` sweeps."""
        h1, h2 = v.new_zeros(len(v), len(self.c1)), v.new_zeros(len(v), len(self.c2))
        visible = self.h1_logits(v, r, h2)
        for _ in range(_ROUNDS if len(self.c2) else 1):
            h1 = bernoulli((visible + h2 @ self.J.T).sigmoid(), generator)
            h2 = bernoulli(self.h2_logits(h1).sigmoid(), generator)
        return h1, h2

    def sweep(
        self, state: State, free: Free, temperature: float, generator: torch.Generator
    ) -> tuple[State, Objects, Relations]:
        """Sample h2, h1, free objects and relations. Return state, p(objects), p(relations)."""
        h2 = bernoulli((self.h2_logits(state.h1) / temperature).sigmoid(), generator)
        logits = self.h1_logits(state.v, state.r, h2)
        h1 = bernoulli((logits / temperature).sigmoid(), generator)
        state = State(state.v, state.r, h1, h2)
        v, object_p = self.sample_objects(state, free, temperature, generator)
        relation_p = (self.relation_logits(v, h1) / temperature).sigmoid() * self.gate(v)
        r = torch.where(free.r, bernoulli(relation_p, generator), state.r)
        return State(v, r, h1, h2), object_p, relation_p


def _fixed(value: Tensor) -> nn.Parameter:
    """Return a weight without automatic differentiation: `Machine.update` has the gradient."""
    return nn.Parameter(value, requires_grad=False)


class RBM(Machine):
    """Objects and relations are joined to the context only."""


class GBM(Machine):
    """The RBM with two-way edges g between each relation and its subject and object."""

    def __init__(
        self, triples: Tensor, V: int, H1: int, H2: int, generator: torch.Generator
    ) -> None:
        super().__init__(triples, V, H1, H2, generator)
        self.g = _fixed(_SCALE * torch.randn((2, len(triples)), generator=generator))

    def add_products(self, state: State, step: float) -> None:
        """Also add to g: -dE/dg is the relation times the presence of its subject or object."""
        super().add_products(state, step)
        for g, presence in zip(self.g, self.presence(state.v), strict=True):
            g.add_((state.r * presence).sum(0), alpha=step)

    def relation_logits(self, v: Objects, h1: H1Units) -> Relations:
        subject, object_ = self.presence(v)
        return super().relation_logits(v, h1) + self.g[0] * subject + self.g[1] * object_

    def relation_field(self, state: State) -> Objects:
        return self.sum_by_class(state.r * self.g[0], state.r * self.g[1])


class GatedRBM(Machine):
    """The RBM with gates. Its relations do not act on objects."""

    def gate(self, v: Objects) -> Relations:
        subject, object_ = self.presence(v)
        return subject * object_


class Triway(GatedRBM):
    """Tri-way edges r_e v_i v_j: a relation also acts on its objects."""

    def relation_field(self, state: State) -> Objects:
        """Add the logit of each relation that is on to each object whose partner is present."""
        logits = state.r * self.relation_logits(state.v, state.h1)
        subject, object_ = self.presence(state.v)
        same = self.subject == self.object  # v_i v_i = v_i: such a triple counts once, without gate
        return self.sum_by_class(
            logits * object_.masked_fill(same, 1.0), logits * subject.masked_fill(same, 0.0)
        )


@dataclass(frozen=True)
class Variant:
    """A machine: its name in tables, its class and its hidden units."""

    title: str
    kind: type[Machine]
    H1: int
    H2: int


VARIANTS: Final = {
    "rbm": Variant("RBM", RBM, 200, 0),
    "gbm": Variant("GBM", GBM, 200, 100),
    "triway": Variant("Triway", Triway, 200, 100),
    "triway-1": Variant("Triway, one layer", Triway, 200, 0),
    "gated-rbm": Variant("RBM, gated relations", GatedRBM, 200, 0),
}
"""The machines of the paper, and two that tell the gate, the tri-way edges and h2 apart."""


LEARNING_RATE: Final = 0.5
BATCH: Final = 32
PATIENCE: Final = 30
EPOCHS: Final = 200
LARGEST_WEIGHT: Final = 50.0
"""Limit of |w|. A larger weight is a sign of divergence: a logit of 20 is a certainty of 1e-9."""
KINDS: Final = ("objects", "relations")


@dataclass(frozen=True)
class Epoch:
    """Errors E of objects and relations, which are 0 without annotated scenes."""

    objects: float
    relations: float
    validation_objects: float
    validation_relations: float
    seconds: float


def phases(
    machine: Machine, scenes: Scenes, generator: torch.Generator, steps: int = 1
) -> tuple[State, State, Float[Tensor, "B"], Float[Tensor, "B"]]:
    """Run both phases. Return their last states, and the errors E of objects and of relations."""
    # `start` is the positive phase, which has the scenes; `state` becomes the negative phase.
    v, r, free = scenes.v, scenes.r, Free.of(scenes.v, scenes.annotated, scenes.r)
    start = state = State(v, r, *machine.hidden(v, r, generator))
    object_p, relation_p = v, r
    for _ in range(steps):
        state, object_p, relation_p = machine.sweep(state, free, 1.0, generator)
    hidden = (start.h1, start.h2)
    draws = [torch.rand(h.shape, generator=generator, dtype=h.dtype) for h in hidden]
    positive, negative = (_with_context(machine, end, draws) for end in (start, state))
    object_error = (v - object_p).square().sum(1)
    relation_error = ((r - relation_p) * free.r).square().sum(1)
    return positive, negative, object_error, relation_error


def _with_context(machine: Machine, state: State, draws: Sequence[Tensor]) -> State:
    """Sample h1 and h2 with these random numbers. Return the state with the mean of h1 given h2."""
    # The effect of v and r on h1. That of h2 is added below, first from its old value.
    visible = machine.h1_logits(state.v, state.r, torch.zeros_like(state.h2))
    h1 = (draws[0] < (visible + state.h2 @ machine.J.T).sigmoid()).to(visible.dtype)
    h2 = (draws[1] < machine.h2_logits(h1).sigmoid()).to(visible.dtype)
    return State(state.v, state.r, (visible + h2 @ machine.J.T).sigmoid(), h2)


def train(
    machine: Machine,
    material: Material,
    generator: torch.Generator,
    epochs: int = EPOCHS,
    rate: float = LEARNING_RATE,
) -> list[Epoch]:
    """Train a machine in place, and return the errors of each epoch."""
    history: list[Epoch] = []
    best, best_epoch, weights = math.inf, 0, machine.state_dict()
    for epoch in range(epochs):
        history.append(_epoch(machine, material, generator, rate))
        _check(machine, len(history), rate)
        score = history[-1].validation_objects + history[-1].validation_relations
        if score < best:
            best, best_epoch = score, epoch
            weights = {name: value.clone() for name, value in machine.state_dict().items()}
        elif epoch - best_epoch >= PATIENCE:
            break
    machine.load_state_dict(weights)
    return history


def _epoch(machine: Machine, material: Material, generator: torch.Generator, rate: float) -> Epoch:
    """Update the weights once by each batch of training scenes, and return the errors."""
    start, batch_errors = time.perf_counter(), []
    for index in torch.randperm(len(material.train), generator=generator).split(BATCH):
        positive, negative, *error = phases(machine, material.train.rows(index), generator)
        machine.update(positive, negative, rate)
        batch_errors.append(error)
    seconds = time.perf_counter() - start  # of the training alone
    validation = errors(machine, material.validation, generator)
    return Epoch(*_averages(batch_errors, material.train), *validation, seconds)


def errors(machine: Machine, scenes: Scenes, generator: torch.Generator) -> tuple[float, float]:
    """Return the error E of objects and of relations, averaged over scenes."""
    batches = torch.arange(len(scenes)).split(BATCH)
    batch_errors = [phases(machine, scenes.rows(index), generator)[2:] for index in batches]
    return _averages(batch_errors, scenes)


def _averages(batches: Sequence[Sequence[Tensor]], scenes: Scenes) -> tuple[float, float]:
    objects, relations = (float(torch.cat(error).sum()) for error in zip(*batches, strict=True))
    return objects / len(scenes), relations / max(int(scenes.annotated.sum()), 1)


def _check(machine: Machine, epoch: int, rate: float) -> None:
    """Raise FloatingPointError if a weight is NaN or above `LARGEST_WEIGHT`."""
    for name, weight in machine.named_parameters():
        largest = float(weight.abs().max()) if weight.numel() else 0.0
        if not largest <= LARGEST_WEIGHT:  # also true for NaN
            raise FloatingPointError(
                f"training diverged in epoch {epoch}: a weight of {name} has the size "
                f"{largest:.4g}, the limit is {LARGEST_WEIGHT:g}. Use a smaller learning rate than "
                f"{rate:g}"
            )
