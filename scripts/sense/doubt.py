"""Measure the doubt about detections on scenes that the model has never seen.

    python -m scripts.sense.doubt MODEL FILE... [--store model_store] [--scenes 1000] [--kept-out]

Each FILE has scenes with labels (`training.datasets.read_scenes`). A model of detectors sees them
(`training.datasets.detections`). Printed are, for each file:

- the area under the curve of `real` and of the confidence, for right detections against ghosts, and
  against ghosts and swapped labels; and the ratio of both distances from 1.
- MRR of a removed class, and the share of right room types: of the rest of the scene, and with one
  intruder listed, with and without its doubt. The loss is the difference to the scene without it.
- the shares of single rooms, and of all rooms of a home together, with `several-rooms`.
- swapped labels with the true label as alternative, both with confidences of a swapped label: the
  share for which the detector, and the service, prefers the true one; the same for right labels.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from sklearn.metrics import roc_auc_score

from app.model import SceneModel
from app.questions.alternatives import Guesses, label_probabilities
from app.questions.doubt import believed, doubt, room_odds
from app.questions.posterior import Posterior
from app.questions.several_rooms import several_rooms
from app.registry import Store
from training.datasets import EncodedScene, encode, read_scenes
from training.datasets.cases import scene_rng
from training.datasets.detections import GHOST, Detector
from training.datasets.homes import homes_of
from training.datasets.splits import split
from training.datasets.vocabulary import plain_scenes
from training.evaluation.parts import of_classes
from training.fit.calibrate_doubt import detector_of, seen_scene

_SEED: Final = 11


def auc(model: SceneModel, scenes: Sequence[EncodedScene], detector: Detector) -> None:
    """Print the areas under the curve of `real` and of the confidence."""
    structure = model.vocabulary.structure.tolist()
    rows = list[NDArray[np.float64]]()
    for encoded in scenes:
        seen = detector.draw(encoded, structure, scene_rng(encoded, _SEED))
        if len(seen.classes) < 2:
            continue
        scene = seen_scene(seen)
        posterior = Posterior(model, scene)
        real = doubt(model, posterior, posterior.given_rest()[0]).real
        rows.append(np.column_stack([real, seen.confidence, seen.right, seen.truth == GHOST]))
    real, confidence, right, ghost = np.concatenate(rows).T
    for name, kept in (("ghosts", (right + ghost) > 0), ("all errors", right >= 0)):
        of_real, of_confidence = (
            float(roc_auc_score(right[kept], value[kept])) for value in (real, confidence)
        )
        ratio = (1 - of_real) / (1 - of_confidence)
        print(
            f"  AUC, {name}: real {of_real:.3f}, confidence {of_confidence:.3f}, ratio {ratio:.2f}"
        )
    brier = np.mean((real - right) ** 2) / np.mean((right.mean() - right) ** 2)
    print(f"  real above .5 for {(real[ghost > 0] >= 0.5).mean():.2f} of the ghosts, ", end="")
    print(f"{(real[right > 0] >= 0.5).mean():.3f} of the right ones; Brier skill {1 - brier:.2f}")


def intruders(model: SceneModel, scenes: Sequence[EncodedScene], detector: Detector) -> None:
    """Print how much an intruder takes from the answers, with and without its doubt."""
    vocabulary = model.vocabulary
    laws = {"by popularity": detector.share, "uniform": (detector.share > 0) / 1.0}
    for law, share in laws.items():
        ranks, rooms = list[list[float]](), list[list[bool]]()
        for encoded in scenes:
            rng = scene_rng(encoded, _SEED)
            classes = encoded.evidence.classes[~vocabulary.structure[encoded.evidence.classes]]
            if len(classes) < 4:
                continue
            hidden = int(rng.choice(classes))
            listed = [c for c in classes.tolist() if c != hidden]
            p = share.copy()
            p[classes] = 0.0
            intruder = int(rng.choice(len(p), p=p / p.sum()))
            if vocabulary.related[[*listed, intruder], hidden].any():
                continue
            lists = of_classes(listed), of_classes(sorted([*listed, intruder]))
            without, raw = (Posterior(model, scene) for scene in lists)
            doubted = believed(model, lists[1])
            ranks.append([1 / _rank(model, one, hidden) for one in (without, raw, doubted)])
            if encoded.room_type >= 0:
                tables = (
                    without.room_log_p()[0],
                    raw.room_log_p()[0],
                    room_odds(model, lists[1]).log_p,
                )
                rooms.append([int(table.argmax()) == encoded.room_type for table in tables])
        for name, values in (("MRR", ranks), ("room", rooms)):
            _print_loss(f"{name}, intruder {law}", np.array(values, float))


def _rank(model: SceneModel, posterior: Posterior, hidden: int) -> int:
    vocabulary, listed = model.vocabulary, posterior.present.classes
    usable = ~vocabulary.structure
    usable[listed] = False
    usable &= ~vocabulary.related[listed].any(0)
    values = posterior.absent_log_odds(np.arange(len(usable)), model.calibration.coverage)
    return 1 + int((values[usable] > values[hidden]).sum())


def _print_loss(name: str, values: Float[NDArray[np.float64], "N 3"]) -> None:
    without, raw, with_doubt = values.mean(0)
    std = (values[:, 1] - values[:, 2]).std() / len(values) ** 0.5
    print(f"  {name}: {without:.4f} without it; lost {without - raw:+.4f}, ", end="")
    print(f"with doubt {without - with_doubt:+.4f} (standard error {std:.4f}, n {len(values)})")


def labels(model: SceneModel, scenes: Sequence[EncodedScene], detector: Detector) -> None:
    """Print how often the detector and the service prefer the right label."""
    structure = model.vocabulary.structure.tolist()
    rows = list[tuple[bool, bool, bool]]()
    for encoded in scenes:
        seen = detector.draw(encoded, structure, scene_rng(encoded, _SEED))
        guesses = {
            row: Guesses(["", ""], [int(c), int(other)], [p, q])
            for row, (c, p, _, other, q) in enumerate(zip(*seen, strict=True))
            if other >= 0
        }
        if len(seen.classes) < 2 or not guesses:
            continue
        for row, p in label_probabilities(model, seen_scene(seen), guesses).items():
            is_first = bool(seen.right[row])
            by_detector = seen.confidence[row] > seen.other_confidence[row]
            rows.append((is_first, bool(by_detector == is_first), bool((p[0] > 0.5) == is_first)))
    first, by_detector, decided = np.array(rows).T
    for name, kept in (("swapped", ~first), ("right", first)):
        shares = by_detector[kept].mean(), decided[kept].mean()
        print(f"  {name} labels: detector {shares[0]:.3f}, decided {shares[1]:.3f}, n {kept.sum()}")


def rooms(model: SceneModel, scenes: Sequence[EncodedScene], _: Detector) -> None:
    """Print the shares of single rooms and of whole homes with the warning `several-rooms`."""
    structure = model.vocabulary.structure

    def is_warned(parts: Sequence[EncodedScene]) -> bool:
        classes = np.concatenate([part.instance_classes for part in parts])
        return bool(several_rooms(model, of_classes(classes[~structure[classes]].tolist())))

    homes = homes_of(scenes)
    single = np.mean([is_warned([scene]) for scene in scenes])
    print(f"  several rooms: {single:.3f} of {len(scenes)} rooms warned", end="")
    if homes:
        print(f", {np.mean([is_warned(home) for home in homes]):.3f} of {len(homes)} homes", end="")
    print()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("model")
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--store", type=Path, default=Path("model_store"))
    parser.add_argument("--scenes", type=int, default=1000)
    parser.add_argument("--kept-out", action="store_true", help="leave training scenes out")
    options = parser.parse_args()
    store = Store(options.store)
    model = store.load(*store.resolve(options.model)).model
    detector = detector_of(model)
    for path in options.files:
        name = path.name.split(".")[0]
        read, _ = plain_scenes([replace(one, source=name) for one in read_scenes(path)])
        if options.kept_out:
            parts = (split(read, seed=0, protocol=protocol) for protocol in ("final", "group"))
            trained = {one.scene_id for part in parts for one in part["train"]}
            read = [one for one in read if one.scene_id not in trained]
        scenes = encode(read, model.vocabulary)
        kept = np.random.default_rng(_SEED).permutation(len(scenes))[: options.scenes]
        print(path.name)
        rooms(model, scenes, detector)
        for measure in (auc, intruders, labels):
            measure(model, [scenes[k] for k in kept.tolist()], detector)


if __name__ == "__main__":
    main()
