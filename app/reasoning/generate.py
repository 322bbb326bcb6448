"""What would a scene like this look like?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from app.boltzmann.gibbs import State
from app.reasoning.answers import GeneratedScene
from app.reasoning.chains import clamped, held_units, run_block
from app.reasoning.evidence import observe
from app.reasoning.log_score import log_score
from app.registry.artifact import Artifact
from app.scene.relations import CANONICAL
from app.scene.scene import Scene

STEPS = 50
"""Gibbs sweeps of a chain unless a request says otherwise."""

Triple = tuple[int, int, int]


@torch.inference_mode()
def generate(
    artifact: Artifact,
    scene: Scene,
    *,
    count: int = 1,
    seed: int,
    steps: int | None = None,
    temperature: float = 1.0,
    context: Mapping[str, Sequence[int]] | None = None,
) -> tuple[GeneratedScene, ...]:
    """Draw scenes that contain the evidence, by block Gibbs chains that start at fantasies.

    Objects of the scene are in every drawn one, whatever their confidence, and so are its
    relations; what it shows not to hold stays off; all else is drawn. Structure that is no
    evidence is drawn with the rest and left out of the answer.

    Chains run in blocks of fixed size, each with a random stream of its own and always whole. So
    scene k depends on the seed and on k, not on how many others a request asked for.

    Structure stands in no relation but those of the evidence.

    Of a(x, y) and a(y, x), which exclude each other, the one that is likelier given the context
    stays where both were drawn; evidence stays in any case. A class stands in a relation to itself
    only where the evidence says so, since a drawn scene holds every class once.

    Args:
        count: how many scenes.
        seed: of the random numbers; the same seed draws the same scenes.
        steps: Gibbs sweeps of a chain, `STEPS` by default.
        temperature: of the chains; above 1 for more varied scenes.
        context: layer name ("h1", "h2") to the units that are held on.

    Raises:
        ValueError: a number out of range, or a layer or unit that the machine does not have.
    """
    machine = artifact.machine
    steps = STEPS if steps is None else steps
    if count < 1:
        raise ValueError(f"count must be at least 1, not {count}")
    if seed < 0:
        raise ValueError(f"seed must not be negative, not {seed}")
    if steps < 1:
        raise ValueError(f"steps must be at least 1, not {steps}")
    if not temperature > 0:
        raise ValueError(f"temperature must be positive, not {temperature}")
    observation = observe(machine, scene)
    clamp = clamped(observation, held_units(machine, context or {}))
    tempered = machine if temperature == 1 else machine.scaled(1 / temperature)
    shown = observation.present | ~torch.tensor(artifact.vocabulary.structure)
    of = observation.classes[observation.row].tolist()
    given = {(a, of[i], of[j]) for a, i, j in scene.relations or ()}
    drawn: list[GeneratedScene] = []
    block = 0
    while len(drawn) < count:
        state = run_block(
            artifact.fantasies, observation, clamp, tempered, steps, _stream(seed, block)
        )
        drawn += _scenes(artifact, state, shown, given, clamp.room)
        block += 1
    return tuple(drawn[:count])


def _stream(seed: int, block: int) -> int:
    """A seed for a block, unrelated to those of neighbouring seeds and blocks."""
    sequence = np.random.SeedSequence(seed, spawn_key=(block,))
    return int(sequence.generate_state(1, np.uint64)[0])


def _scenes(
    artifact: Artifact, state: State, shown: Tensor, given: set[Triple], room: Tensor | None
) -> list[GeneratedScene]:
    machine, labels = artifact.machine, artifact.vocabulary.labels
    structure = artifact.vocabulary.structure
    edges = state.edges
    v = state.v * shown
    logits = machine.relation_logits(edges, state.v, state.h1)
    drawn = (state.r > 0) & (edges.ends_present(v) > 0)
    r = torch.zeros_like(state.r)
    triples: list[list[Triple]] = []
    for row in range(len(v)):
        units = drawn[row].nonzero().squeeze(1)
        place = 0 if len(edges.relation) == 1 else row
        names = zip(
            edges.relation[place, units].tolist(),
            edges.subject[place, units].tolist(),
            edges.object[place, units].tolist(),
            strict=True,
        )
        likelihood = dict(zip(names, logits[row, units].tolist(), strict=True))
        kept = [triple for triple in likelihood if _stays(triple, likelihood, given, structure)]
        r[row, units[[triple in set(kept) for triple in likelihood]]] = 1.0
        triples.append(sorted({*kept, *given}))
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


def _stays(
    triple: Triple,
    likelihood: Mapping[Triple, float],
    given: set[Triple],
    structure: NDArray[np.bool_],
) -> bool:
    a, i, j = triple
    if triple in given:
        return True
    mirrored = (a, j, i)
    # Training drops the relations of structure, so what is drawn of them means nothing.
    if i == j or mirrored in given or structure[i] or structure[j]:
        return False
    if mirrored not in likelihood:
        return True
    return (likelihood[triple], -i) > (likelihood[mirrored], -j)


def _context(state: State, row: int) -> dict[str, tuple[int, ...]]:
    layers = {"h1": state.h1, "h2": state.h2} if state.h2.shape[1] else {"h1": state.h1}
    return {
        layer: tuple(units[row].nonzero().squeeze(1).tolist()) for layer, units in layers.items()
    }
