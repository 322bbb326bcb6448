"""Scenes drawn by any machine: whole blocks of chains, in tensors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from app.boltzmann.gibbs import State
from app.reasoning.answers import GeneratedScene
from app.reasoning.chains import clamped, held_units, run_block
from app.reasoning.evidence import observe
from app.reasoning.exclusion import Triple, staying
from app.reasoning.log_score import log_score
from app.reasoning.plausible import ATTEMPTS, Plausible
from app.registry.artifact import Artifact
from app.scene.relations import CANONICAL
from app.scene.scene import Scene


@torch.inference_mode()
def block_scenes(
    artifact: Artifact,
    scene: Scene,
    count: int,
    seed: int,
    steps: int,
    temperature: float,
    context: Mapping[str, Sequence[int]],
    stop: Callable[[], bool],
) -> tuple[GeneratedScene, ...]:
    """See `generate`. Every block has a random stream of its own."""
    machine = artifact.machine
    observation = observe(machine, scene)
    clamp = clamped(observation, held_units(machine, context))
    tempered = machine if temperature == 1 else machine.scaled(1 / temperature)
    shown = observation.present | ~torch.tensor(artifact.vocabulary.structure)
    of = observation.classes[observation.row].tolist()
    given = {(a, of[i], of[j]) for a, i, j in scene.relations or ()}
    drawn: list[GeneratedScene] = []
    block, plausible = 0, Plausible(artifact, scene)
    while len(drawn) < count and not stop():
        found: list[GeneratedScene] = []
        fitting: list[bool] = []
        for attempt in range(ATTEMPTS):
            stream = _stream(seed, block, attempt)
            state = run_block(artifact.fantasies, observation, clamp, tempered, steps, stream)
            again = _scenes(artifact, state, shown, given, clamp.room)
            # What is plausible stays; the rest is replaced by the same chains of the next attempt.
            found = [
                old if fits else new
                for old, new, fits in zip(
                    found or again, again, fitting or [False] * len(again), strict=True
                )
            ]
            fitting = [plausible(one.objects) for one in found]
            if all(fitting) or stop():
                break
        drawn += found
        block += 1
    return tuple(drawn[:count])


def _stream(seed: int, block: int, attempt: int) -> int:
    """A seed for an attempt at a block, unrelated to those of neighbouring seeds and blocks."""
    sequence = np.random.SeedSequence(seed, spawn_key=(block, attempt))
    return int(sequence.generate_state(1, np.uint64)[0])


def _scenes(
    artifact: Artifact, state: State, shown: Tensor, given: set[Triple], room: Tensor | None
) -> list[GeneratedScene]:
    machine, labels = artifact.machine, artifact.vocabulary.labels
    edges = state.edges
    v = state.v * shown
    logits = machine.relation_logits(edges, state.v, state.h1)
    drawn = (state.r > 0) & (edges.ends_present(v) > 0)
    r = torch.zeros_like(state.r)
    names = torch.stack([edges.relation, edges.subject, edges.object], -1)
    triples: list[list[Triple]] = []
    for row in range(len(v)):
        units = drawn[row].nonzero().squeeze(1)
        named = names[0 if len(names) == 1 else row, units].numpy()
        stay = staying(named, logits[row, units].numpy(), given, artifact.vocabulary.structure)
        r[row, units[torch.from_numpy(stay)]] = 1.0
        triples.append(sorted({*map(tuple, named[stay].tolist()), *given}))
    scores = log_score(machine, v, r, edges, state.h1, room).tolist()
    return [
        GeneratedScene(
            objects=tuple(labels[i] for i in v[row].nonzero().squeeze(1).tolist()),
            relations=tuple((labels[i], CANONICAL[a], labels[j]) for a, i, j in triples[row]),
            log_score=scores[row],
            context=_context(state, row),
        )
        for row in range(len(v))
    ]


def _context(state: State, row: int) -> dict[str, tuple[int, ...]]:
    layers = {"h1": state.h1, "h2": state.h2} if state.h2.shape[1] else {"h1": state.h1}
    return {
        layer: tuple(units[row].nonzero().squeeze(1).tolist()) for layer, units in layers.items()
    }
