"""What else should be here, and where?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from app.reasoning.answers import MissingAnswer
from app.reasoning.calibration import missing_scores, placed_scores
from app.reasoning.evidence import draw_context, observe
from app.reasoning.objects import absent_log_odds
from app.reasoning.placements import log_p_at, placements
from app.reasoning.relations import best
from app.registry.artifact import Artifact
from app.scene.relations import CANONICAL, canonicalise
from app.scene.scene import Scene


@torch.inference_mode()
def missing(
    artifact: Artifact,
    scene: Scene,
    *,
    top_k: int = 10,
    candidates: Sequence[int] | None = None,
    at: tuple[str, int] | None = None,
) -> tuple[MissingAnswer, ...]:
    """Absent classes by the probability that they were taken away, likeliest first.

    The probabilities are a softmax over *all* absent classes but structure, so they sum to one over
    these whatever `top_k` and `candidates` leave of them. A present class is never proposed.

    Args:
        top_k: at most so many.
        candidates: class indices to choose from; present classes and structure among them are
            passed over.
        at: (relation, position of an object): the missing thing stood so to that object.

    Raises:
        ValueError: top_k below 1, a candidate outside the vocabulary, an unknown relation, or an
            anchor that is no object of the scene.
    """
    machine, calibration = artifact.machine, artifact.calibration
    if top_k < 1:
        raise ValueError(f"top_k must be at least 1, not {top_k}")
    place = _place(scene, machine.spec.A, at)
    observation = observe(machine, scene)
    structure = torch.tensor(artifact.vocabulary.structure)
    absent = (~observation.present & ~structure).nonzero().squeeze(1)
    chosen = _chosen(absent, machine.spec.V, candidates)
    if not bool(chosen.any()):
        return ()
    draws = draw_context(machine, observation.evidence)
    log_odds = absent_log_odds(artifact, observation.evidence, absent, draws)
    scores = missing_scores(calibration, log_odds)
    if place is not None:
        relation, anchor, outgoing = place
        row = int(observation.row[anchor])
        log_p = log_p_at(observation, draws, absent, relation, row, outgoing=outgoing)
        scores = placed_scores(calibration, log_odds, log_p)
    # By score: probabilities of far classes may all round to zero.
    where = torch.from_numpy(best(scores.numpy(), chosen.numpy(), top_k))
    anchors = (~structure[observation.classes]).nonzero().squeeze(1)
    return tuple(
        MissingAnswer(artifact.vocabulary.labels[index], probability, value, standing)
        for index, probability, value, standing in zip(
            absent[where].tolist(),
            torch.softmax(scores, dim=0)[where].tolist(),
            log_odds[where].tolist(),
            placements(observation, draws, absent[where], anchors, calibration),
            strict=True,
        )
    )


def _place(
    scene: Scene, relations: int, at: tuple[str, int] | None
) -> tuple[int, int, bool] | None:
    """(canonical relation, object, whether the missing thing is the relation's subject)."""
    if at is None:
        return None
    name, anchor = at
    if not 0 <= anchor < len(scene.objects):
        raise ValueError(f"anchor {anchor} is none of the {len(scene.objects)} objects")
    relation, subject, _ = canonicalise("missing", name, "anchor")
    if relation >= relations:
        raise ValueError(f"the model has no relation {name!r}, only {CANONICAL[:relations]}")
    return relation, anchor, subject == "missing"


def _chosen(absent: Tensor, classes: int, candidates: Sequence[int] | None) -> Tensor:
    """(N,) bool over the absent classes."""
    if candidates is None:
        return torch.ones(len(absent), dtype=torch.bool)
    for index in candidates:
        if not 0 <= index < classes:
            raise ValueError(f"candidate {index} must be a class index below V = {classes}")
    return torch.from_numpy(np.isin(absent.numpy(), np.array(candidates, dtype=np.int64)))
