"""Compare served log-odds with the conditionals of the joint distribution of a machine.

    python -m training.research.joint places-triway@4.5.1 scenes.jsonl

A request without a profile has an unknown data source q. The answers use the mean base rate over
the sources, sum_q p(q | listed) a_q. With q as one more unit of the machine, the joint is

    p(v, h1, t, q) ~ exp(f_q - E(v, h1, t | q)),

and its conditionals average the odds instead: log sum_q p(q | listed) exp(a_q). Answers about
objects also leave out observed relations. In the joint, these change the hidden units. The sum over
all states of h1 is too large to compute, so importance sampling estimates it.

The command prints the mean difference of the log-odds over random lists of the scenes of a file,
and the mean reciprocal rank of hidden classes by both log-odds. The weights u of whole scenes and
kappa take no part: they belong to sampling and to the questions.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from jaxtyping import Bool, Float
from torch import Tensor

from app.registry import DEFAULT_STORE, Store
from training.datasets.batches import SceneTensors
from training.datasets.cases import some_scenes
from training.domain.terminal import StorePath
from training.evaluation.parts import draw_parts, exactly, rank_hidden
from training.evaluation.report import read_test
from training.evaluation.setting import Structure, with_relations
from training.machines import BoltzmannMachine, machine_of
from training.machines.edges import Edges

_LENGTHS = (3, 8)
_LISTS = 300
_FIRST = 10  # likeliest unlisted classes, which an answer lists
_DRAWS = 4000


def joint_log_odds(machine: BoltzmannMachine, v: Float[Tensor, "B V"]) -> Float[Tensor, "B V"]:
    """Return the log-odds of each unlisted class in the joint with a source unit."""
    if not machine.spec.profiles:
        return machine.object_log_odds(v)
    p = machine.source_weights(v, None)
    of_source = (p.log().unsqueeze(-1) + machine.a).logsumexp(1)
    return machine.object_log_odds(v) - p @ machine.a + of_source


def joint_room_log_p(machine: BoltzmannMachine, v: Float[Tensor, "B V"]) -> Float[Tensor, "B C"]:
    """Return log p(t | v) of each room type in the joint with a source unit."""
    logits = machine.e + machine.hidden_log_odds(machine.hidden_logits(v), machine.Q)
    if machine.spec.coupled:
        logits = logits + v @ machine.Y.T
    if not machine.spec.profiles:
        return logits.log_softmax(-1)
    of_source = machine.f + v @ machine.a.T
    return (of_source.unsqueeze(-1) + logits.unsqueeze(1) + machine.y).logsumexp(1).log_softmax(-1)


def change_by_relations(
    machine: BoltzmannMachine,
    v: Float[Tensor, "1 V"],
    edges: Edges,  # the relation units between the listed classes
    r: Float[Tensor, "1 units"],
    observed: Bool[Tensor, "1 units"],
    generator: torch.Generator,
    draws: int = _DRAWS,
) -> Float[Tensor, " V"]:
    """Estimate the change of the log-odds of each unlisted class by observed relations.

    The change is log E[exp(W_i h1) | v, r] - log E[exp(W_i h1) | v]. States of h1 are drawn from
    p(h1 | v), and weighted by p(r | v, h1).
    """
    x = machine.by_unit(machine.hidden_logits(v))[0]
    states = torch.cat([torch.zeros_like(x[:, :1]), x], 1).softmax(1)
    drawn = torch.multinomial(states, draws, replacement=True, generator=generator).T
    one_hot = torch.nn.functional.one_hot(drawn, machine.spec.states)
    h1 = one_hot[..., 1:].flatten(1).to(v.dtype)  # without the first state of each unit
    logits = machine.relation_logits(edges, v, h1.unsqueeze(1)).squeeze(1)
    is_unit = observed[0] & (machine.gate(edges, v)[0] > 0)
    log_p = (r[0] * logits - torch.nn.functional.softplus(logits))[:, is_unit].sum(1)
    weight = log_p.softmax(0)
    factors = (h1 @ machine.W.T).exp()  # exp(W_i h1) of each draw and class i
    return (weight @ factors).log() - factors.mean(0).log()


@torch.no_grad()
def compare_sources(
    machine: BoltzmannMachine, scenes: SceneTensors, structure: Structure, length: int
) -> dict[str, float]:
    """Return the mean differences of log-odds by the source unit in lists of some length."""
    parts = draw_parts(some_scenes(scenes, _LISTS, 0), structure, exactly(length))
    v = parts.v.double()
    served, joint = machine.object_log_odds(v), joint_log_odds(machine, v)
    absent = (v == 0) & ~structure
    row, listed = (v > 0).nonzero(as_tuple=True)
    others = v[row].scatter(1, listed.unsqueeze(1), 0.0)
    rest = joint_log_odds(machine, others) - machine.object_log_odds(others)
    first = served.masked_fill(~absent, -torch.inf).topk(_FIRST, 1).indices
    change = (joint - served).abs()
    figures = {
        "lists": float(len(v)),
        "unlisted classes": float(change[absent].mean()),
        "first ten": float(change.gather(1, first).mean()),
        "listed classes": float(rest.gather(1, listed.unsqueeze(1)).abs().mean()),
        "MRR, served": rank_hidden(parts, structure, served.float()).mrr().value,
        "MRR, joint": rank_hidden(parts, structure, joint.float()).mrr().value,
    }
    if machine.spec.C:
        room = (joint_room_log_p(machine, v).exp() - machine.room_log_p(v).exp()).abs()
        figures["room types, p of the likeliest"] = float(room.max(1).values.mean())
    return figures


@torch.no_grad()
def compare_relations(
    machine: BoltzmannMachine, scenes: SceneTensors, structure: Structure
) -> dict[str, float]:
    """Return the mean differences of log-odds by the observed relations of whole scenes."""
    related = with_relations(scenes)
    order = torch.randperm(len(related), generator=torch.Generator().manual_seed(0))
    generator = torch.Generator().manual_seed(0)
    every, first = [], []  # mean change of all unlisted classes, and of the likeliest ones
    for k in order[:_LISTS]:
        batch = related.batch(k.unsqueeze(0))
        edges, r, observed = machine.lay_out(replace(batch, holds=batch.holds.double()))
        v = batch.v.double()
        change = change_by_relations(machine, v, edges, r, observed, generator).abs()
        absent = (v[0] == 0) & ~structure
        odds = machine.object_log_odds(v)[0].masked_fill(~absent, -torch.inf)
        every.append(float(change[absent].mean()))
        first.append(float(change[odds.topk(_FIRST).indices].mean()))
    if not every:
        return {}
    return {
        "scenes with relations": float(len(every)),
        "unlisted classes": float(np.mean(every)),
        "first ten": float(np.mean(first)),
    }


def main(
    model: Annotated[str, typer.Argument(help="stored model, NAME@VERSION")],
    file: Annotated[Path, typer.Argument(help="scenes in any format that training reads")],
    store: StorePath = DEFAULT_STORE,
) -> None:
    """Print the differences between served log-odds and those of the joint."""
    models = Store(store)
    artifact = models.load(*models.resolve(model)).model
    setting = read_test(file).setting(artifact.vocabulary)
    asked = machine_of(artifact.weights).double(), setting.scenes, setting.structure
    tables = {f"unknown source, {n} classes": compare_sources(*asked, n) for n in _LENGTHS}
    for title, figures in {**tables, "observed relations": compare_relations(*asked)}.items():
        values = ", ".join(f"{name} {value:.4g}" for name, value in figures.items())
        typer.echo(f"{title}: {values or 'no such scenes'}")


if __name__ == "__main__":
    typer.run(main)
