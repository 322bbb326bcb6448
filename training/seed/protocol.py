"""The four tasks of Bozcan et al. (2018), with the reference rows "frequency" and "nothing".

A sampled reconstruction answers each question: the model gets a scene, samples the context and then
the free units, and the sample is the answer. `ONE_PASS` is one sweep at temperature 1. `ANNEALED`
cools the temperature from 2 to 1.

    T1  relations  All objects are listed, and no relation. Share of listed relations that are on
    T2  missing    One random class is removed. Share of removed classes that are on again. In the
                   published code, the listed relations of the removed class stay on. They force
                   the class on in a gated machine and hint at it in the others. A second variant
                   deletes these relations
    T3  extra      One random absent class is added. Number of wrong objects after reconstruction,
                   divided by V as in the paper, and by the objects of the scene as in the code of
                   the authors. Returning the input makes one error in each scene
    T4  generate   One hidden unit is on, and the others have their training mean or are 0

Each share has its price beside it. More relations that are on raise T1, so precision is reported.
More objects that are on raise T2, so false objects are reported.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import torch
from jaxtyping import Float, Int
from torch import Tensor

from app.scene import Vocabulary
from training.seed.machines import Free, Machine, State, bernoulli
from training.seed.scenes import Scenes

ONE_PASS: Final = (1.0,)
ANNEALED: Final = tuple(2.0 - step / 10 for step in range(11))

PAPER: Final = {
    "T1 on": {"rbm": 0.0560, "gbm": 0.1418, "triway": 0.2335},
    "T2 on, relations left": {"rbm": 0.3512, "gbm": 0.4094, "triway": 0.4328},
    "T3 error / V": {"rbm": 0.6446, "gbm": 0.1404, "triway": 0.0789},
}
"""Results of Bozcan et al. (2018) on their own data, by metric and variant."""

Visible = tuple[Tensor, Tensor]
Answer = Callable[[Tensor, Tensor, Free, torch.Generator], Visible]
"""Takes v, r, the free units and a generator. Returns reconstructed v and r."""

_ROWS: Final = 3  # hidden units of T4
_DRAWN: Final = 40  # scenes of each hidden unit
_SHOWN: Final = 8  # most frequent classes of a hidden unit


def machine_answer(machine: Machine, schedule: Sequence[float] = ONE_PASS) -> Answer:
    """Return the reconstruction by Gibbs sweeps at these temperatures."""

    def answer(v: Tensor, r: Tensor, free: Free, generator: torch.Generator) -> Visible:
        state = State(v, r, *machine.hidden(v, r, generator))
        for temperature in schedule:
            state, _, _ = machine.sweep(state, free, temperature, generator)
        return state.v, state.r

    return answer


def frequency_answer(triples: Int[Tensor, "T 3"], train: Scenes) -> Answer:
    """Return the reconstruction by frequencies in the training scenes, without any context."""
    subject, object_ = triples[:, 1], triples[:, 2]
    both = train.v[:, subject] * train.v[:, object_] * train.annotated.unsqueeze(1)
    # p(r_e) is the share of listed relations among the annotated scenes with both classes.
    object_p, relation_p = train.v.mean(0), train.r.sum(0) / both.sum(0).clamp(min=1)

    def answer(v: Tensor, r: Tensor, free: Free, generator: torch.Generator) -> Visible:
        v = torch.where(free.v, bernoulli(object_p.expand(v.shape), generator), v)
        p = relation_p * v[:, subject] * v[:, object_]
        return v, torch.where(free.r, bernoulli(p, generator), r)

    return answer


def nothing_answer(v: Tensor, r: Tensor, free: Free, generator: torch.Generator) -> Visible:  # noqa: ARG001
    return v, r


def measure(
    answer: Answer, triples: Int[Tensor, "T 3"], test: Scenes, seed: int
) -> dict[str, float]:
    """Return all figures of T1 to T3. T1 is left out without listed relations."""
    generator = torch.Generator().manual_seed(seed)
    figures = relations_on(answer, test, generator)
    for name, left in (("relations left", True), ("relations deleted", False)):
        values = removed_on(answer, triples, test, left, generator)
        figures |= {f"T2 {metric}, {name}": value for metric, value in values.items()}
    return figures | extra_errors(answer, test, generator)


def relations_on(answer: Answer, test: Scenes, generator: torch.Generator) -> dict[str, float]:
    """Measure T1 over the scenes with listed relations."""
    scenes = test.rows(test.labelled > 0)
    if not len(scenes):
        return {}
    off = torch.zeros_like(scenes.r)
    free = Free(torch.zeros_like(scenes.v).bool(), torch.ones_like(off).bool())
    _, r = answer(scenes.v, off, free, generator)
    hits, on, labelled = float((r * scenes.r).sum()), float(r.sum()), float(scenes.labelled.sum())
    return {
        "T1 on": hits / labelled,
        "T1 precision": hits / max(on, 1.0),
        "T1 relations on a scene": on / len(scenes),
        "T1 listed relations a scene": labelled / len(scenes),
    }


def removed_on(
    answer: Answer,
    triples: Int[Tensor, "T 3"],
    test: Scenes,
    left: bool,
    generator: torch.Generator,
) -> dict[str, float]:
    """Measure T2 over scenes of two or more classes; with `left`, no relations are deleted."""
    scenes = test.rows(test.v.sum(1) >= 2)
    removed = torch.multinomial(scenes.v, 1, generator=generator)
    shown = scenes.v.scatter(1, removed, 0.0)
    present = scenes.v if left else shown
    is_fixed = (present[:, triples[:, 1]] * present[:, triples[:, 2]]).bool()
    free = Free(shown == 0, ~is_fixed & scenes.annotated.unsqueeze(1))
    v, _ = answer(shown, scenes.r * is_fixed, free, generator)
    return {
        "on": float(v.gather(1, removed).mean()),
        "false objects": float((v * (1 - scenes.v)).sum(1).mean()),
    }


def extra_errors(answer: Answer, test: Scenes, generator: torch.Generator) -> dict[str, float]:
    """Measure T3. All units are free, and sampling starts at the scene with the added class."""
    added = torch.multinomial(1 - test.v, 1, generator=generator)
    altered = test.v.scatter(1, added, 1.0)
    v, _ = answer(altered, test.r, Free.of(altered, test.annotated, test.r), generator)
    wrong = float((v - test.v).abs().sum())
    return {
        "T3 error / V": wrong / test.v.numel(),
        "T3 error / objects": wrong / float(test.v.sum()),
        "T3 extra off": 1 - float(v.gather(1, added).mean()),
    }


def generate(
    machine: Machine, train: Scenes, vocabulary: Vocabulary, seed: int
) -> tuple[dict[str, float], dict[str, list[str]]]:
    """Measure T4 for the units of h1 whose mean varies most; also return classes by unit."""
    generator = torch.Generator().manual_seed(seed)
    _, h2 = machine.hidden(train.v, train.r, generator)
    mean = machine.h1_logits(train.v, train.r, h2).sigmoid()
    units = mean.var(0).topk(min(_ROWS, mean.shape[1])).indices
    # A pair of sampled classes is "seen" if both classes are in one training scene.
    seen = (train.v.T @ train.v) > 0
    figures, classes = {}, {}
    for name, rest in (("mean", mean.mean(0)), ("zero", torch.zeros_like(mean[0]))):
        h1 = rest.repeat(len(units), 1)
        h1[range(len(units)), units] = 1.0
        v = _objects_given(machine, h1.repeat_interleave(_DRAWN, 0), generator)
        pairs = torch.einsum("bi,bj->ij", v, v).fill_diagonal_(0)
        share = (pairs * seen).sum() / pairs.sum().clamp(min=1)
        figures[f"T4 objects a scene, others {name}"] = float(v.sum(1).mean())
        figures[f"T4 pairs seen, others {name}"] = float(share)
        for unit, drawn in zip(units.tolist(), v.split(_DRAWN), strict=True):
            top = drawn.mean(0).topk(min(_SHOWN, v.shape[1])).indices.tolist()
            classes[f"unit {unit}, others {name}"] = [vocabulary.objects[i].label for i in top]
    return figures, classes


def _objects_given(
    machine: Machine, h1: Float[Tensor, "B H1"], generator: torch.Generator
) -> Float[Tensor, "B V"]:
    """Sample objects given h1 by ten alternations with relations."""
    v, r, h2 = (h1.new_zeros(len(h1), len(bias)) for bias in (machine.b, machine.d, machine.c2))
    free = Free(torch.ones_like(v).bool(), torch.ones_like(r).bool())
    for _ in range(10):
        state = State(v, r, h1, h2)
        v, _ = machine.sample_objects(state, free, 1.0, generator)
        r = bernoulli(machine.relation_logits(v, h1).sigmoid() * machine.gate(v), generator)
    return v
