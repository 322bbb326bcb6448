"""Contrastive divergence (CD) and persistent contrastive divergence (PCD).

The gradient of the negative log-likelihood is <dE>_data - <dE>_model. The loss is the difference
between the energies of data states and of model samples. Automatic differentiation then gives the
update for every machine variant. The energy has two forms, seed and local
(`training.machines.machine`). In the seed form, h1 is summed out (Rao–Blackwell), so the loss uses
free energies given v, r and h2.

In the local form, the sum over relations is 1 given v and h1. The gradient of the relation term
under the model has mean zero, so the loss leaves it out. The loss is the difference of the energies
of (v, h1, h2), minus log p(r | v, h1) of the data.

Sources: Hinton, "Training products of experts by minimizing contrastive divergence" (2002);
Tieleman, "Training RBMs using approximations to the likelihood gradient" (2008); Montavon and
Müller, "Deep Boltzmann machines and the centering trick" (2012); Melchior, Fischer and Wiskott,
"How to center deep Boltzmann machines" (2016).
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from training.datasets.batches import Batch, relation_units
from training.fit.configuration import ObjectiveConfig
from training.fit.objectives.base import Objective, bernoulli_nll, withhold_rooms
from training.machines import BoltzmannMachine
from training.machines.bernoulli import bernoulli
from training.machines.distributed import anywhere, gather, mean_part, share, total
from training.machines.gibbs import Clamp, gibbs_step, initial_state, reconstruct, sample_h1
from training.machines.machine import State
from training.machines.mean_field import Evidence, mean_field

_OFFSETS = ("offset_v", "offset_h1", "offset_h2")


@torch.no_grad()
def data_state(
    machine: BoltzmannMachine, batch: Batch, room: Tensor, generator: torch.Generator
) -> tuple[State, Tensor]:
    """Return a state with the objects and relations of the batch, and a mask of observed relations.

    The hidden units are sampled from the mean-field fixed point given the observed relations.
    Unobserved relations are sampled given the objects and hidden units.
    """
    edges, r, observed = relation_units(machine, batch)
    field = mean_field(machine, Evidence(batch.v, edges, r, observed, room), iterations=5)
    h1 = bernoulli(field.y.sigmoid(), generator)
    h2 = bernoulli(field.h2, generator)
    if anywhere(~observed & edges.valid):
        p = machine.relation_logits(edges, batch.v, h1).sigmoid() * machine.gate(edges, batch.v)
        r = torch.where(observed, r, bernoulli(p, generator))
    return State(batch.v, h1, h2, r, edges), observed


def energy_difference(
    machine: BoltzmannMachine,
    data: State,
    observed: Tensor,
    model: State,
    data_room: Tensor,
    model_room: Tensor,
) -> Tensor:
    """Return the loss, the difference between data states and model samples.

    In the seed form, the loss is mean F(data) - mean F(model), with the free energy F. In the local
    form, the energy E replaces F, and -log p(r | v, h1) of the data is added.
    """
    if not machine.relations_act:
        logits = machine.relation_logits(data.edges, data.v, data.h1)
        nll = bernoulli_nll(logits, data.r, observed * machine.gate(data.edges, data.v)).sum(-1)
        positive = machine.object_energy(data.v, data.h1, data.h2, data_room) + nll
        negative = machine.object_energy(model.v, model.h1, model.h2, model_room)
        return mean_part(positive) - mean_part(negative)
    # Both terms in one pass. The states are reachable, so the gate need not be checked.
    bare, context = machine.linear_relations(data.edges, data.v, data.r)
    model_bare, model_context = machine.linear_relations(model.edges, model.v, model.r)
    free = machine.free_energy_given(
        torch.cat([data.v, model.v]),
        torch.cat([context, model_context]),
        torch.cat([data.h2, model.h2]) if machine.spec.H2 else None,
        torch.cat([data_room, model_room]),
    ).split([len(data.v), len(model.v)])
    return mean_part(free[0] - bare) - mean_part(free[1] - model_bare)


class ContrastiveDivergence(Objective):
    """CD-k: the model samples come from k Gibbs steps that start at the data."""

    def loss(self, machine: BoltzmannMachine, batch: Batch, generator: torch.Generator) -> Tensor:
        room = withhold_rooms(batch, self.config.room_dropout, generator)
        data, observed = data_state(machine, batch, room, generator)
        relations = machine.relations_act
        clamp = Clamp(room=room)
        # The h1 of the data starts the first reconstruction.
        model = reconstruct(machine, data, generator, clamp, collapsed=False, relations=relations)
        for _ in range(self.config.k - 1):
            model = gibbs_step(
                machine, model, generator, clamp, collapsed=False, relations=relations
            )
        if not machine.relations_act:
            # The energies use sampled h1. After one step, the model sample still contains the h1 of
            # the data. If h1 were equal in both terms, c1 and J would have no gradient.
            model = replace(model, h1=sample_h1(machine, model, generator, clamp))
        return energy_difference(machine, data, observed, model, room, room)


class PersistentCD(Objective):
    """PCD-k with centred gradients. The Gibbs chains continue from one update to the next."""

    def __init__(
        self, config: ObjectiveConfig, machine: BoltzmannMachine, structure: Tensor | None = None
    ) -> None:
        super().__init__(config, machine, structure)
        spec = machine.spec
        self.chains: State | None = None
        # Chains of a checkpoint, which the next update continues.
        self.saved: dict[str, Tensor] = {}
        # Running averages of the data means of v, h1 and h2, which centre the gradients.
        self.offsets = [torch.full((n,), 0.5) for n in (spec.V, spec.H1, spec.H2)]

    def loss(self, machine: BoltzmannMachine, batch: Batch, generator: torch.Generator) -> Tensor:
        free = torch.full((len(batch),), -1)
        data, observed = data_state(machine, batch, free, generator)
        chains = self._resume(machine, generator)
        relations = machine.relations_act
        for _ in range(self.config.k):
            chains = gibbs_step(machine, chains, generator, relations=relations)
        self.chains = chains
        for offset, block in zip(self.offsets, (data.v, data.h1, data.h2), strict=True):
            offset.lerp_(total(mean_part(block)), 0.01)
        no_room = torch.full((len(chains.v),), -1)
        return energy_difference(machine, data, observed, chains, free, no_room)

    def adjust_gradients(self, machine: BoltzmannMachine) -> None:
        centre_gradients(machine, *self.offsets)

    def _resume(self, machine: BoltzmannMachine, generator: torch.Generator) -> State:
        if self.chains is not None:
            return self.chains
        if not self.saved:
            chains = len(share(torch.arange(self.config.chains)))
            b = machine.b.detach().sigmoid().expand(chains, -1)
            return initial_state(machine, bernoulli(b, generator), generator)
        edges = machine.edges(share(self.saved["classes"]))
        blocks = {name: share(self.saved[name]) for name in ("v", "h1", "h2", "r")}
        return State(edges=edges, **blocks)

    def state(self) -> dict[str, Tensor]:
        """Return the running means, the chains and the classes of the chains' relation units."""
        state = dict(zip(_OFFSETS, self.offsets, strict=True))
        if self.chains is None:
            return state
        blocks = {name: gather(getattr(self.chains, name)) for name in ("v", "h1", "h2", "r")}
        return state | blocks | {"classes": gather(self.chains.edges.classes)}

    def load_state(self, state: dict[str, Tensor]) -> None:
        self.offsets = [state[name] for name in _OFFSETS]
        self.saved = {name: value for name, value in state.items() if name not in _OFFSETS}


@torch.no_grad()
def centre_gradients(
    machine: BoltzmannMachine, mu: Tensor, lambda1: Tensor, lambda2: Tensor
) -> None:
    """Replace the gradients of (b, c1, c2, W, J) by centred gradients, in place.

    μ, λ1 and λ2 are running data means of v, h1 and h2. d<v>, d<h1> and d<vh1> are differences
    between data means and model means. The centred gradient of W is d<vh1> - μ d<h1>' - d<v> λ1'.
    The product of the centred weight gradients and the means is subtracted from each bias gradient.
    """
    b, c1, c2 = (getattr(machine, name).grad for name in ("b", "c1", "c2"))
    W, J = machine.W.grad, machine.J.grad
    if b is None or c1 is None or W is None:
        raise ValueError(
            "the gradient of b, c1 or W is missing; call backward() before centre_gradients()"
        )
    before_b, before_c1 = b.clone(), c1.clone()
    W.sub_(torch.outer(mu, before_c1)).sub_(torch.outer(before_b, lambda1))
    b.sub_(W @ lambda1)
    c1.sub_(mu @ W)
    if J is None or c2 is None or not machine.spec.H2:
        return
    before_c2 = c2.clone()
    J.sub_(torch.outer(lambda1, before_c2)).sub_(torch.outer(before_c1, lambda2))
    c1.sub_(J @ lambda2)
    c2.sub_(lambda1 @ J)
