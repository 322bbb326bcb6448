"""`python -m scripts.estimators`: errors of two estimators of the answers of a model.

The two estimators are the closed form of the service, and an average over 64 samples of the hidden
units. The reference is an average over many more samples (by default 4,096). The scenes contain
objects that the model sampled, with one of three kinds of evidence: labels only, 20 random
relations, or random poses, which determine hundreds of relations. Errors for objects are
differences of log-odds. Errors for relations and placements are differences of probabilities.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from numpy.typing import NDArray

from app.inference.elementary import sigmoid
from app.questions.posterior import Posterior
from app.registry import Artifact, Store, load_model_set
from app.scene import Scene, SceneObject, derive_relations
from training.oracle.drawn import DrawnPosterior

Values = NDArray[np.floating[Any]]

_OBJECTS = 12
_RELATIONS = 20


def scenes(artifact: Artifact, count: int, kind: str) -> Iterator[Scene]:
    """Generate scenes from the stored samples of a model.

    Args:
        count: number of samples to use. Samples with fewer than four classes are skipped.
        kind: evidence beside the labels: "bare" (none), "relations" or "poses".
    """
    rng = np.random.default_rng(0)
    for v in artifact.weights.scenes[:count]:
        classes = np.flatnonzero(v)[:_OBJECTS].tolist()
        n = len(classes)
        if n < 4:
            continue
        labels = artifact.vocabulary.labels
        objects = tuple(SceneObject(labels[c], labels[c], c) for c in classes)
        if kind == "bare":
            yield Scene(objects)
        elif kind == "relations":
            found: dict[tuple[int, int, int], None] = {}
            while len(found) < min(_RELATIONS, n * (n - 1)):
                a, i, j = (int(x) for x in rng.integers((3, n, n)))
                if i != j and (a, j, i) not in found:
                    found[a, i, j] = None
            yield Scene(objects, tuple(found))
        else:
            places = np.c_[rng.uniform(0, 3, (n, 2)), rng.uniform(0, 1, n)]
            poses = derive_relations(places.tolist(), [[0.5, 0.5, 0.5]] * n)
            triples = tuple((int(a), int(i), int(j)) for a, i, j in np.argwhere(poses.holds))
            yield Scene(objects, triples, poses=poses)


def answers(given: Posterior, absent: NDArray[np.int64]) -> dict[str, Values]:
    """Return the log-odds or probabilities of four kinds of answers about a scene.

    Args:
        given: model with the evidence of the scene.
        absent: (classes,) indices of the absent classes. Placements use about five of them.
    """
    anchors, likely = np.arange(len(given.present.classes)), absent[:: len(absent) // 5]
    return {
        "absent objects": given.absent_log_odds(absent),
        "present objects": given.log_odds_given_rest(),
        "relations": sigmoid(given.relation_log_odds()),
        "placements": sigmoid(np.stack(given.placement_log_odds(likely, anchors))),
    }


def errors(artifact: Artifact, count: int, draws: int) -> dict[tuple[str, str, str], list[Values]]:
    """Return the absolute errors, by (kind of evidence, kind of answer, estimator).

    Args:
        count: number of stored samples that serve as scenes.
        draws: number of samples of the hidden units in the reference.
    """
    structure = artifact.vocabulary.structure
    found: dict[tuple[str, str, str], list[Values]] = {}
    few: Callable[[Scene], Any] = lambda scene: DrawnPosterior(artifact, scene)  # noqa: E731
    for kind in ("bare", "relations", "poses"):
        for scene in scenes(artifact, count, kind):
            with (
                patch("training.oracle.evidence.DRAWS", draws),
                patch("training.oracle.evidence._RELATION_DRAWS", 1 << 40),
            ):
                exact = few(scene)
                present = exact.present.classes
                absent = np.setdiff1d(np.flatnonzero(~structure), present)
                reference = answers(exact, absent)
            for name, given in (
                ("closed form", Posterior(artifact, scene)),
                ("64 draws", few(scene)),
            ):
                for answer, values in answers(given, absent).items():
                    difference = np.abs(values - reference[answer]).ravel()
                    found.setdefault((kind, answer, name), []).append(difference)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--store", type=Path, default=Path("model_store"))
    parser.add_argument("--model", default="default")
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--draws", type=int, default=4096)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    artifact = load_model_set(Store(asked.store)).resolve(asked.model)
    found = errors(artifact, asked.scenes, asked.draws)
    print("| scenes | answer | closed form, mean / max | 64 draws, mean / max |")
    print("|---|---|---|---|")
    for kind, answer in dict.fromkeys(key[:2] for key in found):
        cells = []
        for name in ("closed form", "64 draws"):
            values = np.concatenate(found[kind, answer, name])
            cells.append(f"{values.mean():.4f} / {values.max():.3f}")
        print(f"| {kind} | {answer} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
