"""What does not belong here, or stands in the wrong place?"""

from __future__ import annotations

import torch
from torch import Tensor

from app.boltzmann.log_odds import object_log_odds
from app.reasoning.answers import Because, MisplacedAnswer, OutlierAnswer
from app.reasoning.calibration import false_log_odds, intruder_log_odds
from app.reasoning.evidence import DRAWS, Observation, draw_context, observe
from app.reasoning.objects import presence_log_odds
from app.reasoning.relations import class_log_odds
from app.registry.artifact import Artifact
from app.scene.relations import CANONICAL
from app.scene.scene import Scene

REASONS = 3
"""How many other objects an answer names as reasons."""

EXPLAINED = 32
"""Reasons are given for so many objects at most, the least fitting ones: each costs n rows."""

# Where a scene shows very many relations, reasons are given for fewer objects, so that their rows
# hold about so many relation units in all.
_REASON_UNITS = 1 << 22

# Rows are taken in blocks of about so many relation units times draws, to bound memory.
_BLOCK = 1 << 22


@torch.inference_mode()
def outliers(
    artifact: Artifact, scene: Scene, *, threshold: float | None = None
) -> tuple[tuple[OutlierAnswer, ...], tuple[MisplacedAnswer, ...]]:
    """Every object, least fitting first, and every stated relation, least likely first.

    An object is judged by the log-odds of its class given the rest of the scene: all instances of
    the class, and all relations that touch it, are taken out first. So instances of one class
    score alike. Ties go by position.

    Args:
        threshold: probability from which an object is called an outlier; by default the model's.

    Raises:
        ValueError: a threshold outside [0, 1].
    """
    calibration = artifact.calibration
    if threshold is None:
        threshold = calibration.outlier_threshold
    if not 0 <= threshold <= 1:
        raise ValueError(f"threshold must be in [0, 1], not {threshold}")
    if not scene.objects:
        return (), ()
    observation = observe(artifact.machine, scene)
    log_odds = log_odds_given_rest(observation)
    intruder = intruder_log_odds(calibration, log_odds, len(log_odds))
    order = intruder[observation.row].sort(descending=True, stable=True).indices
    explained = order[: _affordable(observation)]
    reasons = _reasons(observation, list(dict.fromkeys(observation.row[explained].tolist())))
    rows, values = observation.row.tolist(), log_odds.tolist()
    probability = torch.sigmoid(intruder).tolist()
    labels = artifact.vocabulary.labels
    classes = observation.classes.tolist()
    found = tuple(
        OutlierAnswer(
            object=position,
            label=labels[classes[row := rows[position]]],
            probability=probability[row],
            log_odds=values[row],
            is_outlier=probability[row] >= threshold,
            because=reasons.get(row, ()),
        )
        for position in order.tolist()
    )
    return found, _misplaced(artifact, observation, scene)


@torch.inference_mode()
def misplaced(artifact: Artifact, scene: Scene) -> tuple[MisplacedAnswer, ...]:
    """Every stated relation, least likely first: what `outliers` says of them, and no more."""
    if not scene.objects:
        return ()
    return _misplaced(artifact, observe(artifact.machine, scene), scene)


def log_odds_given_rest(observation: Observation) -> Tensor:
    """Log-odds of each present class given the scene without it, (n,)."""
    machine, n = observation.machine, len(observation.classes)
    alone = torch.eye(n, dtype=torch.bool)
    parts = []
    for classes in torch.arange(n).split(_rows(observation.unit_count * DRAWS)):
        rest = observation.without(alone[classes])
        draws = None if rest.edges is None else draw_context(machine, rest, rows=n)
        candidates = observation.classes[classes].unsqueeze(1)
        parts.append(presence_log_odds(machine, rest, candidates, draws).squeeze(1))
    return torch.cat(parts)


def _rows(size: int) -> int:
    """How many rows of that size to take at a time."""
    return max(1, _BLOCK // max(1, size))


def _affordable(observation: Observation) -> int:
    """For how many objects to give reasons."""
    per_object = len(observation.classes) * max(1, observation.unit_count)
    return min(EXPLAINED, max(1, _REASON_UNITS // per_object))


def _reasons(observation: Observation, explained: list[int]) -> dict[int, tuple[Because, ...]]:
    """For each explained class, the other classes that change its log-odds most."""
    classes = len(observation.classes)
    if classes < 2:
        return dict.fromkeys(explained, ())
    change = _leave_one_out(observation, torch.tensor(explained))
    # The class itself is no reason; its place sorts last.
    change[torch.arange(len(explained)), explained] = 0.0
    order = change.abs().sort(dim=1, descending=True, stable=True).indices
    order = order[:, : min(REASONS, classes - 1)]
    positions = observation.first[order].tolist()
    values = change.gather(1, order).tolist()
    return {
        row: tuple(Because(position, value) for position, value in zip(*found, strict=True))
        for row, *found in zip(explained, positions, values, strict=True)
    }


def _leave_one_out(observation: Observation, rows: Tensor) -> Tensor:
    """Log-odds of classes given the rest, minus the same without one class of it, (N, n).

    With the context at its mean field on both sides: the difference of two estimates from draws
    would be lost in their noise. The scene without i and j judges i without j and j without i.
    """
    machine, n = observation.machine, len(observation.classes)
    wanted = torch.zeros(n, dtype=torch.bool)
    wanted[rows] = True
    pairs = (wanted.unsqueeze(1) | wanted).triu().nonzero().contiguous()
    alone = torch.eye(n, dtype=torch.bool)
    parts = [
        object_log_odds(
            machine,
            observation.without(alone[part].any(1)),
            candidates=observation.classes[part],
        )
        for part in pairs.split(_rows(observation.unit_count))
    ]
    log_odds = torch.cat(parts)
    without = log_odds.new_zeros(n, n)
    i, j = pairs.unbind(1)
    without[i, j], without[j, i] = log_odds.unbind(1)
    without = without[rows]
    # The diagonal takes out nothing but the class itself: it is judged by the whole rest.
    return without.gather(1, rows.unsqueeze(1)) - without


def _misplaced(
    artifact: Artifact, observation: Observation, scene: Scene
) -> tuple[MisplacedAnswer, ...]:
    """The scene's relations that the machine knows, least likely first, ties by their order."""
    stated = [triple for triple in scene.relations or () if triple[0] < artifact.machine.spec.A]
    if not stated:
        return ()
    relation, subject, object_ = torch.tensor(stated).unbind(1)
    log_odds = class_log_odds(observation)[
        relation, observation.row[subject], observation.row[object_]
    ]
    p = torch.sigmoid(false_log_odds(artifact.calibration, log_odds)).tolist()
    return tuple(
        MisplacedAnswer(stated[k][1], CANONICAL[stated[k][0]], stated[k][2], p[k])
        for k in log_odds.sort(stable=True).indices.tolist()
    )
