"""T1b: the other half of a scene's relations, given its classes and a random half of them.

The triples are canonical and distinct before they are split, so that no triple is held out in one
spelling (left) and given in the other (right). Given triples are no candidates, nor are their
mirror images a(y, x), which a given a(x, y) all but excludes. Everything that is not given is
unobserved. Scenes with fewer than two triples are skipped. Otherwise as T1a.
"""

from __future__ import annotations

import torch
from torch import Tensor

from training.batches import Batch, SceneTensors
from training.evaluation.cases import scene_rng
from training.evaluation.relations import (
    Candidates,
    RelationScore,
    candidates_of,
    number,
    scorable,
    spread_units,
    telling,
)
from training.machines import BoltzmannMachine, Triway
from training.machines.draws import draw_hidden
from training.machines.edges import Edges, find_triples, pair_edges, triple_keys
from training.machines.mean_field import Evidence
from training.oracle.units import NO_UNIT, mean_log_p


def given_score(machine: BoltzmannMachine, *, draws: int = 64) -> RelationScore:
    """Log-odds of every relation given the observed ones of the batch, each without itself.

    As the service judges relations: the context is drawn given all that is observed, and an
    observed unit is taken out of the evidence by reweighting the draws, w ← w / p(r_e | v, h1).
    Units without weights in an ungated machine get -inf.
    """

    def score(batch: Batch) -> Tensor:
        edges, r, observed = given_units(machine, batch)
        evidence = Evidence(batch.v, edges, r, observed)
        context = draw_hidden(machine, evidence, draws=draws)
        logits = machine.relation_logits(edges, batch.v, context.h1)
        gate = machine.gate(edges, batch.v)
        unseen = machine.relation_term(logits, gate, r, torch.zeros_like(observed))
        change = unseen - machine.relation_term(logits, gate, r, observed)
        weight = torch.softmax(context.log_weight.unsqueeze(-1) + change, dim=0)
        given = r * observed
        on, off = mean_log_p(weight, logits + context.implied(machine, edges, given))
        values = torch.where(gate > 0, (on - off).clamp(min=NO_UNIT), -torch.inf)
        if isinstance(machine, Triway):
            return values.view(batch.holds.shape)
        return spread_units(machine, batch.classes, values)

    return score


def given_units(machine: BoltzmannMachine, batch: Batch) -> tuple[Edges, Tensor, Tensor]:
    """(edges, r, observed) of a batch in the machine's layout; what has no unit says nothing."""
    edges = machine.edges(batch.classes, batch.counts)
    if isinstance(machine, Triway):
        return edges, batch.holds.flatten(1), batch.observed.flatten(1)
    pairs = pair_edges(batch.classes, machine.spec.A)
    keys = triple_keys(pairs.relation, pairs.subject, pairs.object, machine.spec.V)
    place, found = find_triples(machine.triple_keys, keys)
    row, slot = (found & pairs.valid).nonzero(as_tuple=True)
    unit = place[row, slot]
    r = batch.v.new_zeros(len(batch), machine.spec.T)
    observed = torch.zeros(r.shape, dtype=torch.bool)
    r[row, unit] = batch.holds.flatten(1)[row, slot]
    observed[row, unit] = batch.observed.flatten(1)[row, slot]
    return edges, r, observed


def random_half(truth: Tensor, scenes: SceneTensors, index: Tensor, seed: int) -> Tensor:
    """Half of each scene's triples (rounded down), (B, A, n, n) bool.

    Args:
        truth: (B, A, n, n) bool, the triples to choose from.
        index: (B,) positions of the scenes.
    """
    given = torch.zeros_like(truth)
    for row, k in enumerate(index.tolist()):
        triples = truth[row].nonzero()
        order = scene_rng(scenes.scenes[k], seed).permutation(len(triples))
        chosen = triples[torch.from_numpy(order[: len(triples) // 2])]
        given[row][tuple(chosen.T)] = True
    return given


@torch.no_grad()
def complete_scenes(
    scenes: SceneTensors,
    structure: Tensor,
    score: RelationScore,
    *,
    seed: int = 0,
    block: int = 16,
) -> list[Candidates]:
    """The candidates of every scene with two triples or more, scored given half of the triples."""
    found: list[Candidates] = []
    related = [k for k, scene in enumerate(scenes.scenes) if scene.evidence.holds.sum() >= 2]
    for index in torch.tensor(related, dtype=torch.int64).split(block):
        if not len(index):
            continue
        batch = scenes.batch(index)
        mask = scorable(batch, structure)
        given = random_half((batch.holds > 0) & mask, scenes, index, seed)
        values = score(telling(batch, given))
        # A single triple cannot be divided: nothing of it was given.
        divided = given.any(-1).any(-1).any(-1)[:, None, None, None]
        found += candidates_of(batch, values, mask & ~given & ~given.mT & divided)
    return number(found)
