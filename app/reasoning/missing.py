"""What else should be here, and where?"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from app.reasoning.answers import Because, MissingAnswer, Placement, entries
from app.reasoning.calibration import missing_logits, placed_logits
from app.reasoning.listing import absent_things, likeliest_classes
from app.reasoning.placements import place_log_p, placements
from app.reasoning.posterior import Posterior, posterior
from app.reasoning.reasons import EXPLAINED, strongest_reasons
from app.registry.artifact import Artifact
from app.scene.frames import Axes, viewer_axes
from app.scene.relations import CANONICAL, canonicalise
from app.scene.scene import Scene

_VIEWER = viewer_axes()
_BLOCK: Final = 32


def missing(
    artifact: Artifact,
    scene: Scene,
    *,
    top_k: int = 10,
    candidates: Sequence[int] | None = None,
    at: tuple[str, int] | None = None,
    coverage: float | None = None,
    axes: Axes | None = _VIEWER,
    details: bool = True,
) -> tuple[MissingAnswer, ...]:
    """Unlisted classes by the probability that they are there all the same, likeliest first.

    A class that is there is listed with probability `coverage`. The lower the coverage, the less an
    unlisted class counts as absent. Each probability is of its own: they do not sum to one. Listed
    classes and structure are never proposed.

    Args:
        top_k: at most so many.
        candidates: class indices to choose from; present classes and structure among them are
            passed over.
        at: (relation, position of an object): the probability is that a class is there, unlisted,
            *and* stands so to that object.
        coverage: from 0 to 1; by default the model's. At 1 unlisted classes count as absent.
        axes: the viewer's, in the frame that offsets are answered in (`viewer_axes`); None where
            nobody knows where the viewer looks.
        details: also say where each would stand, and what speaks for it.

    Raises:
        ValueError: top_k below 1, a coverage outside [0, 1], a candidate outside the vocabulary, an
            unknown relation, or an anchor that is no object of the scene.
    """
    spec, calibration = artifact.spec, artifact.calibration
    if top_k < 1:
        raise ValueError(f"top_k must be at least 1, not {top_k}")
    coverage = calibration.coverage if coverage is None else coverage
    if not 0 <= coverage <= 1:
        raise ValueError(f"coverage must be in [0, 1], not {coverage}")
    place = _place(scene, spec.A, at)
    given = posterior(artifact, scene)
    structure = artifact.vocabulary.structure
    absent = absent_things(structure, given.present.classes)
    chosen = _chosen(absent, spec.V, candidates)
    if not chosen.any():
        return ()
    log_odds = given.absent_posterior(absent, coverage)
    listed = max(1, int(np.count_nonzero(~structure[given.present.classes])))
    if place is None:
        logits = missing_logits(calibration, log_odds, listed)
    else:
        logits = _at_place(artifact, given, place, absent, chosen, log_odds, listed, top_k)
    where, probabilities = likeliest_classes(logits, chosen, top_k)
    found = absent[where]
    labels = artifact.vocabulary.labels
    standing: Sequence[tuple[Placement, ...]] = [()] * len(found)
    because: Sequence[tuple[Because, ...]] = [()] * len(found)
    if details:
        standing = placements(artifact, given, found, axes, place, scene.relations or ())
        because = _reasons(given, found)
    return tuple(
        entries(
            MissingAnswer,
            [labels[index] for index in found.tolist()],
            probabilities.tolist(),
            log_odds[where].tolist(),
            standing,
            because,
        )
    )


def _at_place(
    artifact: Artifact,
    given: Posterior,
    place: tuple[int, int, bool],
    absent: NDArray[np.int64],
    chosen: NDArray[np.bool_],
    log_odds: NDArray[np.floating[Any]],
    listed: int,
    top_k: int,
) -> NDArray[np.floating[Any]]:
    """Logits of p(there) · p(stands so | there) of the best `top_k` candidates at least, (N,).

    Candidates are asked in blocks, the likeliest to be there first. A product is never above its
    first factor: once the next candidate is less likely to be there than `top_k` others are at the
    place, no later one can be among the best. What was not asked is -inf.
    """
    relation, anchor, outgoing = place
    row = int(given.present.row[anchor])
    there = missing_logits(artifact.calibration, log_odds, listed)
    logits = np.full_like(there, -np.inf)
    order = np.flatnonzero(chosen)
    order = order[np.argsort(-there[order], kind="stable")]
    for start in range(0, len(order), _BLOCK):
        some = order[start : start + _BLOCK]
        best = np.sort(logits[order[:start]])[-top_k:]
        if len(best) == top_k and there[some[0]] < best[0]:
            break
        log_p = place_log_p(artifact, given, absent[some], relation, row, outgoing=outgoing)
        logits[some] = placed_logits(artifact.calibration, log_odds[some], log_p, listed)
    return logits


def _reasons(given: Posterior, found: NDArray[np.int64]) -> list[tuple[Because, ...]]:
    """The classes that are there and change the log-odds of what was found most."""
    if not len(given.present.classes):
        return [()] * len(found)
    explained = found[:EXPLAINED]
    reasons = strongest_reasons(given.present, given.reasons_for_absent(explained))
    return reasons + [()] * (len(found) - len(explained))


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


def _chosen(
    absent: NDArray[np.int64], classes: int, candidates: Sequence[int] | None
) -> NDArray[np.bool_]:
    """(N,) bool over the absent classes."""
    if candidates is None:
        return np.ones(len(absent), dtype=np.bool_)
    for index in candidates:
        if not 0 <= index < classes:
            raise ValueError(f"candidate {index} must be a class index below V = {classes}")
    return np.isin(absent, np.array(candidates, dtype=np.int64))
