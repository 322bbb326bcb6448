"""How do these objects stand to each other?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from app.reasoning.answers import RelationAnswer
from app.reasoning.calibration import exclusive, relation_probability
from app.reasoning.evidence import Observation, draw_context, observe
from app.reasoning.units import NO_UNIT, mean_log_p, units_between
from app.registry.artifact import Artifact
from app.scene.relations import CANONICAL, OPPOSITES
from app.scene.scene import Scene


@torch.inference_mode()
def relations(
    artifact: Artifact,
    scene: Scene,
    *,
    top_k: int = 20,
    min_probability: float = 0.0,
    pairs: Sequence[tuple[int, int]] | None = None,
    include_opposites: bool = False,
) -> tuple[RelationAnswer, ...]:
    """The likeliest relations between the objects of a scene, best first, ties by position.

    Relations that the scene states are evidence for the others; each is judged without itself.
    Structure (floor, wall) stands in no relation unless `pairs` asks for it.

    Args:
        top_k: at most so many.
        min_probability: leave out what is less likely.
        pairs: only answers with this (subject, object), positions in `scene.objects`. The order of
            the two counts: the pair says nothing of how its object stands to its subject, but for
            the opposite relations.
        include_opposites: also spell each answer the other way round: right(y, x) for left(x, y).

    Raises:
        ValueError: top_k below 1, a probability outside [0, 1], or a pair that is not two objects.
    """
    if top_k < 1:
        raise ValueError(f"top_k must be at least 1, not {top_k}")
    if not 0 <= min_probability <= 1:
        raise ValueError(f"min_probability must be in [0, 1], not {min_probability}")
    observation = observe(artifact.machine, scene)
    asked = _asked(artifact, scene, pairs)
    if not asked.any():
        return ()
    log_odds = class_log_odds(observation)
    logs = observation.counts.to(log_odds.dtype).log()
    p = relation_probability(artifact.calibration, log_odds, logs[:, None] + logs)
    p, _ = exclusive(p, p.mT)
    names = CANONICAL[: len(p)]
    if include_opposites:
        p = torch.cat([p, p.mT])
        names = names + tuple(OPPOSITES[name] for name in names)
    row = observation.row
    # (N, N, relations): the flat order is that of positions, so a stable sort breaks ties by it.
    grid = p.permute(1, 2, 0)[row][:, row].numpy()
    usable = asked[..., None] & (grid >= min_probability)
    where = best(grid.ravel(), usable.ravel(), top_k)
    subject, object_, relation = np.unravel_index(where, grid.shape)
    return tuple(
        RelationAnswer(x, names[a], y, probability)
        for x, y, a, probability in zip(
            subject.tolist(),
            object_.tolist(),
            relation.tolist(),
            grid.reshape(-1)[where].tolist(),
            strict=True,
        )
    )


def _asked(
    artifact: Artifact, scene: Scene, pairs: Sequence[tuple[int, int]] | None
) -> NDArray[np.bool_]:
    """(N, N) which ordered pairs to answer."""
    size = len(scene.objects)
    if pairs is None:
        structure = artifact.vocabulary.structure
        thing = np.array([not structure[entry.class_index] for entry in scene.objects], dtype=bool)
        usable: NDArray[np.bool_] = thing[:, None] & thing & ~np.eye(size, dtype=np.bool_)
        return usable
    asked = np.zeros((size, size), dtype=np.bool_)
    for subject, object_ in pairs:
        if subject == object_ or not (0 <= subject < size and 0 <= object_ < size):
            raise ValueError(f"pair ({subject}, {object_}) must name two of the {size} objects")
        asked[subject, object_] = True
    return asked


def best(values: NDArray[np.floating], usable: NDArray[np.bool_], count: int) -> NDArray[np.intp]:
    """Positions of the `count` largest usable values, largest first, earlier first among equals."""
    where = np.flatnonzero(usable)
    if len(where) > count:
        # Everything at least as large as the last one wanted, so that ties are not cut at random.
        last = np.partition(values[where], -count)[-count]
        where = where[values[where] >= last]
    order = np.argsort(-values[where], kind="stable")[:count]
    return where[order]


def class_log_odds(observation: Observation) -> Tensor:
    """Log-odds of every relation between the classes of a scene, each without itself, (A, n, n).

        p(r_e = 1 | rest) = E[ sigmoid(ℓ_e(h1) + x_e) ],   h1 from p(h1 | rest)

    with x_e what the observed relations imply for e. The draws are made given all that is observed.
    An observed unit is taken out of the evidence by reweighting them: w ← w / p(r_e | v, h1). A
    relation without a unit has log-odds `NO_UNIT`.
    """
    machine, evidence = observation.machine, observation.evidence
    draws = draw_context(machine, evidence)
    classes, counts = observation.classes, observation.counts
    units = units_between(machine, classes, classes, counts, counts)
    logits = machine.relation_logits(units.edges, evidence.v, draws.h1).squeeze(1)
    log_weight, implied = draws.log_weight, logits.new_zeros(())
    if bool(observation.observed.any()):
        observed = units.flat(observation.observed)
        r = units.flat(observation.holds).to(logits.dtype)
        gate = machine.gate(units.edges, evidence.v)
        unseen = machine.relation_term(logits, gate, r, torch.zeros_like(observed))
        log_weight = log_weight + unseen - machine.relation_term(logits, gate, r, observed)
        # Where e is not observed, the difference is zero and the weights stay as they are.
        implied = draws.implied(machine, units.edges, (r * observed).unsqueeze(0)).squeeze(0)
    on, off = mean_log_p(torch.softmax(log_weight, dim=0), logits + implied)
    return units.grid((on - off).clamp(min=NO_UNIT), NO_UNIT)
