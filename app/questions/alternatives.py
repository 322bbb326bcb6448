"""Objects with several labels: the other objects of the scene decide which label is right.

A detector gives an object labels with confidences c. Sums above 1 are scaled to 1. The probability
of a label of class i is

    p_i = softmax_i(confidence·logit(c_i) + context·z_i)

with the coefficients of `LabelFit`. z_i are the log-odds of the class given the other objects,
without the objects of class i. A class of another object with several labels is present with the
confidence of its label.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from app.errors import Location
from app.inference.elementary import softmax
from app.model.scene_model import SceneModel
from app.questions.names import ErrorList, Unknown
from app.scene.scene import Scene
from scene_client.schemas import Detection

Floats = NDArray[np.floating[Any]]

_CERTAIN: Final = 1.0 - 1e-6  # largest confidence, so that logarithms are finite


@dataclass(frozen=True, slots=True)
class Guesses:
    """The possible labels of one object, of different classes."""

    labels: Sequence[str]  # in the request
    classes: Sequence[int]
    confidence: Sequence[float]  # of each label

    @property
    def shares(self) -> Float[Floats, "labels"]:
        """The confidences, scaled to a sum of at most 1."""
        confidence = np.array(self.confidence)
        return np.minimum(confidence / max(1.0, confidence.sum()), _CERTAIN)


def read_guesses(
    entry: Detection, name: str, at: Location, unknown: Unknown, errors: ErrorList
) -> Guesses:
    """Return the known labels of an object. Labels of one class count as one, with both shares.

    An unknown label adds an error only if the object has no known label.
    """
    own = ErrorList()
    labels: list[str] = []
    classes: list[int] = []
    shares: list[float] = []
    before = len(unknown.ignored)
    stated = [(entry.label, entry.confidence, (*at, "label"))]
    for number, other in enumerate(entry.alternatives):
        stated.append((other.label, other.confidence, (*at, "alternatives", number, "label")))
    for label, confidence, location in stated:
        index = unknown.resolve(label, name, location, own)
        if index in classes:
            shares[classes.index(index)] += confidence
        elif index is not None:
            labels.append(label)
            classes.append(index)
            shares.append(confidence)
    for kind, located in () if classes else own.by_class.items():
        errors.by_class.setdefault(kind, []).extend(located)
    # The object is ignored once if no label is known, and not at all otherwise.
    del unknown.ignored[before + (not classes) :]
    return Guesses(labels, classes, shares)


def label_probabilities(
    model: SceneModel, scene: Scene, guesses: Mapping[int, Guesses]
) -> dict[int, Float[Floats, "labels"]]:
    """Return the probabilities of the labels of some objects, by the index of the object.

    Example:
        >>> names = ["fridge", "stove", "cup"]
        >>> scene = Scene(model.vocabulary.bare_objects(names))
        >>> microwave, tv = map(model.vocabulary.index, ("microwave", "tv"))
        >>> guesses = {2: Guesses(["tv", "microwave"], [tv, microwave], [0.5, 0.4])}
        >>> label_probabilities(model, scene, guesses)[2].argmax()
        1
    """
    logit, z = label_log_odds(model, scene, guesses)
    logits = model.calibration.labels.confidence * logit + model.calibration.labels.context * z
    ends = np.cumsum([len(one.classes) for one in guesses.values()])
    by_object = zip(guesses, np.split(logits, ends[:-1]), strict=True)
    return {row: softmax(values) for row, values in by_object}


def warm_up(model: SceneModel, scene: Scene) -> None:
    """Compile the loops of a decision among labels, with a scene of at least one object."""
    label_probabilities(model, scene, {0: Guesses(["", ""], [0, model.spec.V - 1], [0.5, 0.4])})


def label_log_odds(
    model: SceneModel, scene: Scene, guesses: Mapping[int, Guesses]
) -> tuple[Float[Floats, "labels"], Float[Floats, "labels"]]:
    """Return logit(c) and the log-odds z of all labels of the objects; see the module."""
    shares = {row: one.shares for row, one in guesses.items()}
    entries = [
        (row, guesses[row].classes, shares[row])
        if row in guesses
        else (row, [thing.class_index], np.array([min(thing.confidence, _CERTAIN)]))
        for row, thing in enumerate(scene.objects)
    ]
    classes, column = np.unique(
        np.concatenate([indices for _, indices, _ in entries]), return_inverse=True
    )
    # log of the probability that no object is of each class, by object and in total
    absent = np.zeros((len(entries), len(classes)))
    ends = np.cumsum([len(indices) for _, indices, _ in entries])
    for (row, _, share), columns in zip(entries, np.split(column, ends[:-1]), strict=True):
        absent[row, columns] = np.log1p(-share)
    rows = list(guesses)
    presence = -np.expm1(absent.sum(0) - absent[rows])
    of_row = np.repeat(np.arange(len(rows)), [len(guesses[row].classes) for row in rows])
    targets = np.concatenate([guesses[row].classes for row in rows])
    z = model.objects.given_others(
        classes, presence.astype(np.float32), of_row, targets, scene.profile, scene.room_type
    )
    c = np.concatenate([shares[row] for row in rows])
    return np.log(c / (1.0 - c)), z
