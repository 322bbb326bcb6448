"""Tables of places: on which receptacle of a room does an object belong?

The table is a file of the user (`training.datasets.priors`), such as the votes of Housekeep. A
question is an object and a room of a source. The candidates are all receptacles of the room in the
source. The relevant ones are those with votes for the object.

The service answers as for a robot at a receptacle: the scene lists the receptacle, and `/missing`
returns the probability that the object is there, on top of it or inside it. This probability ranks
the receptacles. A receptacle that the model does not know, or for which it does not propose the
object, ranks last.

Metric: mean average precision (mAP). For ties, the average precision is the expectation under
random order. Two rivals rank the same receptacles: by their votes for all other objects of the room
in the source (popularity), and in random order.

Two kinds of questions are left out and counted. A model cannot propose an unknown object, or
structure such as a wall. If all receptacles are relevant, every order has the precision 1.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from app.registry import Artifact
from app.scene import CANONICAL, Scene, SceneObject
from app.scene.relations import SUPPORTS
from training.datasets.array_types import Flags, Floats
from training.datasets.priors import Placing
from training.evaluation.asking import missing_probabilities
from training.evaluation.metrics import Metric, Ratio

TASK: Final = "Placing"


@dataclass(frozen=True, eq=False)
class Room:
    """A room type of a source: the labels of n objects and m receptacles, and votes (n, m)."""

    name: str
    objects: tuple[str, ...]
    receptacles: tuple[str, ...]
    votes: Floats


class _Result(NamedTuple):
    """The result of one question.

    Attributes:
        group: class of the object. If the model does not know the object, it is the label.
        precision: average precision by name of the ranking, 0 if the question is left out.
        unknown, receptacles: number of receptacles that the model does not know, and of all.
        left_out: reason for leaving out the question, or an empty string.
    """

    group: str
    precision: dict[str, float]
    unknown: int
    receptacles: int
    left_out: str


_UNKNOWN: Final = "left out: unknown object"
_TRIVIAL: Final = "left out: all receptacles are right"
_RIVALS: Final = ("popularity", "random order")


def rooms_of(placings: Iterable[Placing]) -> list[Room]:
    """Return the rooms of one source, sorted by name."""
    by_room: dict[str, list[Placing]] = {}
    for row in placings:
        by_room.setdefault(row.room, []).append(row)
    rooms = []
    for name, rows in sorted(by_room.items()):
        objects = sorted({row.subject for row in rows if row.votes})
        receptacles = sorted({row.receptacle for row in rows})
        votes = np.zeros((len(objects), len(receptacles)))
        for row in rows:
            if row.votes:
                votes[objects.index(row.subject), receptacles.index(row.receptacle)] += row.votes
        rooms.append(Room(name, tuple(objects), tuple(receptacles), votes))
    return rooms


def average_precision(score: Floats, relevant: Flags) -> float:
    """Return the average precision of a ranking, in expectation over random order of ties.

    Args:
        score: (m,) score of each item.
        relevant: (m,) True for relevant items; at least one.

    Source: McSherry and Najork, "Computing information retrieval performance measures efficiently
    in the presence of tied scores" (2008).
    """
    total = 0.0
    above = relevant_above = 0
    for value in np.unique(score)[::-1]:
        tied = score == value
        ties, hits = int(tied.sum()), int((tied & relevant).sum())
        # Given a relevant item at position k of the ties, each of the k items above it among the
        # ties is relevant with the same probability.
        k = np.arange(ties)
        others = k * (hits - 1) / max(ties - 1, 1)
        precision = (relevant_above + 1 + others) / (above + 1 + k)
        total += hits / ties * float(precision.sum())
        above, relevant_above = above + ties, relevant_above + hits
    return total / int(relevant.sum())


def ask_places(artifact: Artifact, room: Room, *, with_room: bool) -> Floats:
    """Return the probability of each object on or in each receptacle, (n, m).

    The value is -inf if the model does not know the receptacle or does not propose the object.

    Args:
        with_room: the scenes also state the room type, if the model knows it.
    """
    vocabulary = artifact.vocabulary
    room_type = vocabulary.room_index(room.name) if with_room else None
    classes = [vocabulary.index(label) for label in room.objects]
    rows = [row for row, index in enumerate(classes) if index is not None]
    candidates = [index for index in classes if index is not None]
    scores = np.full(room.votes.shape, -np.inf)
    for column, label in enumerate(room.receptacles):
        if (index := vocabulary.index(label)) is None:
            continue
        scene = Scene((SceneObject("receptacle", label, index),), room_type=room_type)
        scores[rows, column] = sum(
            missing_probabilities(artifact, scene, (CANONICAL[a], 0), candidates)[candidates]
            for a in SUPPORTS
            if a < artifact.spec.A
        )
    return scores


def placing_metrics(artifact: Artifact, rooms: list[Room]) -> dict[str, Metric]:
    """Return the metrics over all questions of a source.

    The metrics are the mAP of each ranking, the share of unknown receptacles, and the shares of
    left-out questions. Intervals are over the classes of the objects, because all objects of a
    class get the same answers. If all objects have one class, intervals are over the questions.
    """
    results = [result for room in rooms for result in _room_results(artifact, room)]
    is_scored = np.array([not result.left_out for result in results])
    metrics: dict[str, Metric] = {}

    def mean_precision(ranking: str) -> Ratio:
        precision = np.array([result.precision[ranking] for result in results])
        return Ratio.of_scenes(precision, is_scored)

    if is_scored.any():
        model = mean_precision("model")
        metrics["mAP"] = model
        metrics["mAP, room type listed"] = mean_precision("model, room type listed")
        metrics |= {f"mAP of {rival}": mean_precision(rival) for rival in _RIVALS}
        metrics |= {f"mAP minus {rival}": model - mean_precision(rival) for rival in _RIVALS}
        unknown = np.array([result.unknown for result in results], float)
        receptacles = np.array([result.receptacles for result in results], float)
        metrics["unknown receptacles"] = Ratio(unknown * is_scored, receptacles * is_scored)
    for reason in (_UNKNOWN, _TRIVIAL):
        is_left_out = np.array([result.left_out == reason for result in results])
        metrics[reason] = Ratio.of_scenes(is_left_out)
    classes, groups = np.unique([result.group for result in results], return_inverse=True)
    if len(classes) < 2:
        return metrics
    return {name: metric.by(groups) for name, metric in metrics.items()}


def _room_results(artifact: Artifact, room: Room) -> list[_Result]:
    """Return the results of the questions about the objects of a room."""
    vocabulary = artifact.vocabulary
    rankings = {
        "model": ask_places(artifact, room, with_room=False),
        "model, room type listed": ask_places(artifact, room, with_room=True),
        "popularity": room.votes.sum(0) - room.votes,
        "random order": np.zeros_like(room.votes),
    }
    unknown = sum(vocabulary.index(label) is None for label in room.receptacles)
    results = []
    for row, label in enumerate(room.objects):
        relevant = room.votes[row] > 0
        index = vocabulary.index(label)
        is_unknown = index is None or bool(vocabulary.structure[index])
        left_out = _UNKNOWN if is_unknown else _TRIVIAL if relevant.all() else ""
        precision = {
            name: 0.0 if left_out else average_precision(scores[row], relevant)
            for name, scores in rankings.items()
        }
        group = label if index is None else vocabulary.labels[index]
        results.append(_Result(group, precision, unknown, len(relevant), left_out))
    return results
