"""Where an absent object would stand."""

from __future__ import annotations

import torch
from torch import Tensor

from app.boltzmann.draws import HiddenDraws
from app.reasoning.answers import Placement
from app.reasoning.calibration import exclusive, relation_probability
from app.reasoning.evidence import Observation
from app.reasoning.objects import weights_with
from app.reasoning.units import NO_UNIT, mean_log_p, units_between
from app.registry.description import Calibration
from app.scene.relations import CANONICAL, OPPOSITES

PLACES = 3
"""How many placements an answer lists."""

# Candidates are taken in blocks of about so many relation units times draws, to bound memory.
_BLOCK = 1 << 22


def placements(
    observation: Observation,
    draws: HiddenDraws,
    candidates: Tensor,
    anchors: Tensor,
    calibration: Calibration,
) -> list[tuple[Placement, ...]]:
    """The likeliest relations of each candidate to the anchors, best first.

    p(r_e = 1 | v with i, evidence), over draws weighed as if the candidate were there, for all
    relations in both directions; instances of an anchor's class are spoken of by the first. What
    the observed relations imply for those of a candidate is left out.

    Args:
        candidates: (N,) absent classes.
        anchors: (m,) places in `observation.classes`.
    """
    if not len(anchors):
        return [()] * len(candidates)
    per_candidate = 2 * observation.machine.spec.A * len(anchors) * len(draws.h1)
    block = max(1, _BLOCK // per_candidate)
    p = torch.cat(
        [
            _probabilities(observation, draws, part, anchors, calibration)
            for part in candidates.split(block)
        ]
    )
    names = CANONICAL[: observation.machine.spec.A]
    names = names + tuple(OPPOSITES[name] for name in names)
    flat = p.flatten(1)
    value, index = flat.sort(dim=1, descending=True, stable=True)
    first = observation.first[anchors].tolist()
    return [
        tuple(
            Placement(names[place // len(anchors)], first[place % len(anchors)], probability)
            for place, probability in zip(places, probabilities, strict=True)
        )
        for places, probabilities in zip(
            index[:, :PLACES].tolist(), value[:, :PLACES].tolist(), strict=True
        )
    ]


def _probabilities(
    observation: Observation,
    draws: HiddenDraws,
    candidates: Tensor,
    anchors: Tensor,
    calibration: Calibration,
) -> Tensor:
    """(N, 2A, m): the canonical relations of the candidates to the anchors, then the opposites."""
    on, off = _log_p(observation, draws, candidates, anchors, outgoing=True)
    forward = (on - off).clamp(min=NO_UNIT)
    on, off = _log_p(observation, draws, candidates, anchors, outgoing=False)
    backward = (on - off).clamp(min=NO_UNIT)
    logs = observation.counts[anchors].to(forward.dtype).log().expand(len(candidates), -1)
    p, q = exclusive(
        relation_probability(calibration, forward, logs),
        relation_probability(calibration, backward, logs),
    )
    return torch.cat([p, q]).transpose(0, 1)


def log_p_at(
    observation: Observation,
    draws: HiddenDraws,
    candidates: Tensor,
    relation: int,
    anchor: int,
    *,
    outgoing: bool,
) -> Tensor:
    """log p(the candidate stands so to the anchor | it is there, evidence), (N,).

    Args:
        relation: canonical; from the candidate to the anchor if `outgoing`, else back.
        anchor: place in `observation.classes`.
    """
    on, _ = _log_p(observation, draws, candidates, torch.tensor([anchor]), outgoing=outgoing)
    return on[relation, :, 0].clamp(min=NO_UNIT)


def _log_p(
    observation: Observation,
    draws: HiddenDraws,
    candidates: Tensor,
    anchors: Tensor,
    *,
    outgoing: bool,
) -> tuple[Tensor, Tensor]:
    """log p and log (1 - p) of the units between candidates and anchors, (A, N, m)."""
    machine, evidence = observation.machine, observation.evidence
    classes, counts = observation.classes[anchors], observation.counts[anchors]
    # Each unit is judged with its candidate present; no unit sees two candidates.
    v = evidence.v.clone()
    v[:, candidates] = 1.0
    weight = weights_with(machine, evidence, draws, candidates)
    if outgoing:
        units = units_between(machine, candidates, classes, None, counts)
        weight = weight[:, None, :, None]
    else:
        units = units_between(machine, classes, candidates, counts, None)
        weight = weight[:, None, None, :]
    logits = machine.relation_logits(units.edges, v, draws.h1).squeeze(1)
    on, off = mean_log_p(weight, units.grid(logits, NO_UNIT))
    return (on, off) if outgoing else (on.mT, off.mT)
