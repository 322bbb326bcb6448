"""`python -m training words`: how well a model reads words that it has no class for.

The classes of `words.csv` are left out in five parts. Each becomes a word, whose weights are
predicted from the other classes (`app.model.word_weights`). The scenes of `REAL` in the validation
and test parts are listed in part, three times each. The AUC of a class compares the lists that hide
the class with those of scenes without it. The command measures the mean AUC of these scores:

- predicted: the log-odds of the word,
- nearest class: the log-odds of the class with the most similar word vector,
- trained: the log-odds of the class in the model,
- list length: the number of listed classes.

It also measures the MRR of the hidden classes in lists that show a left-out class: with the word,
with its nearest class instead, with the trained class, and without it.

By default, the map of the predicted weights does not see the rows of the left-out classes, but the
training of the other rows did. With `--train`, a model without these classes is trained for each
part.
"""

from __future__ import annotations

import csv
import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import typer
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.stats import rankdata

from app.inference.objects import ObjectScorer
from app.inference.weights import Weights
from app.model import SceneModel
from app.model.word_weights import RowMap
from app.registry import DEFAULT_STORE, Store
from app.scene import Vocabulary
from app.scene.vocabulary import Word
from app.scene.words import word_vectors
from training.datasets import EncodedScene
from training.datasets.cases import scene_rng
from training.datasets.console import console
from training.datasets.files import DATA, write_whole
from training.domain.terminal import StorePath
from training.evaluation.metrics import Ratio, paired_difference
from training.fit.configuration import Config, ConfigError
from training.fit.draft import draft_artifact
from training.fit.trainer import Trainer
from training.research.benchmark import Data, Folder
from training.research.measure import resumable
from training.runs.config_files import load_config
from training.runs.pipeline import prepare

REAL: Final = (
    *("coco_captions", "coco_captions_2014", "coco_labels", "vg_vlchecklist", "amber"),
    *("meetup_ade20k", "behavior1k_rooms", "virtualhome"),
)
"""Permissively licensed sources of photographs and of rooms that people have designed."""

LEFT_OUT: Final = Path(__file__).with_name("words.csv")
"""The left-out classes and their parts: classes that at least ten lists hide."""

_LISTS: Final = 3  # lists of each scene
_LEAST: Final = 3  # least number of classes of a scene
_SHOWN: Final = 20  # most lists with a class, of which the MRR is measured
METHODS: Final = ("predicted", "nearest class", "trained", "list length")
EVIDENCE: Final = ("predicted", "nearest class", "trained", "left out")


@dataclass(frozen=True)
class Lists:
    """Lists of parts of scenes."""

    listed: list[Int[NDArray, " k"]]  # indices of the listed classes of each list
    hides: Bool[NDArray, "lists V"]
    shows: Bool[NDArray, "lists V"]

    @classmethod
    def draw(cls, scenes: Sequence[EncodedScene], vocabulary: Vocabulary) -> Lists:
        """Draw the lists. Structure is neither listed nor hidden."""
        listed: list[Int[NDArray, " k"]] = []
        hidden: list[Int[NDArray, " k"]] = []
        for scene in scenes:
            classes = scene.evidence.classes[~vocabulary.structure[scene.evidence.classes]]
            for seed in range(_LISTS if len(classes) >= _LEAST else 0):
                rng = scene_rng(scene, seed)
                order, count = rng.permutation(classes), int(rng.integers(1, len(classes)))
                listed.append(np.sort(order[:count]))
                hidden.append(order[count:])
        masks = np.zeros((2, len(listed), len(vocabulary)), np.bool_)
        for mask, parts in zip(masks, (hidden, listed), strict=True):
            for row, classes in enumerate(parts):
                mask[row, classes] = True
        return cls(listed, *masks)

    def auc(
        self, scores: Float[NDArray, "lists n"], classes: Int[NDArray, " n"]
    ) -> Float[NDArray, " n"]:
        """Return the AUC of each class from scores of the lists."""
        values = []
        for column, index in enumerate(classes.tolist()):
            hides = self.hides[:, index]
            used = hides | ~self.shows[:, index]
            ranks, n = rankdata(scores[used, column])[hides[used]], int(hides.sum())
            # The Mann-Whitney statistic, divided by the number of pairs of lists.
            values.append((ranks.sum() - n * (n + 1) / 2) / (n * (int(used.sum()) - n)))
        return np.array(values)

    def mrr(
        self,
        scores: Float[NDArray, "rows candidates"],
        rows: Int[NDArray, " rows"],  # indices of the lists
        classes: Int[NDArray, " candidates"],
    ) -> float:
        """Return the MRR of the candidates that some lists hide; NaN without any.

        Other hidden classes do not count as errors.
        """
        ranks: list[float] = []
        for row, values in zip(rows, scores, strict=True):
            hides, shows = self.hides[row, classes], self.shows[row, classes]
            others = values[~hides & ~shows]
            ranks += [1 / (1 + int((others > value).sum())) for value in values[hides]]
        return float(np.mean(ranks)) if ranks else float("nan")


def words(
    model: Annotated[str, typer.Argument(help="NAME or NAME@VERSION in the store")] = "default",
    config: Annotated[str, typer.Option(help="configuration of the model's scenes")] = (
        "places-triway"
    ),
    data: Data = None,
    store: StorePath = DEFAULT_STORE,
    train: Annotated[
        bool, typer.Option("--train", help="train a model without the classes of each part")
    ] = False,
    aliases: Annotated[
        bool, typer.Option("--aliases", help="words have the vectors of their aliases, too")
    ] = False,
    folder: Folder = Path("runs/words"),
) -> None:
    """Measure answers about words that a model has no class for.

    The command writes results.json into the folder.
    """
    with resumable():
        models = Store(store)
        artifact = models.load(*models.resolve(model)).model
        settings, root = load_config(config), data or DATA
        parts = prepare(settings, root, artifact.vocabulary).parts
        scenes = [s for name in ("validation", "test") for s in parts[name] if s.source in REAL]
        lists = Lists.draw(scenes, artifact.vocabulary)
        labels: list[str] = []
        auc, mrr = defaultdict[str, list[float]](list), defaultdict[str, list[float]](list)
        for left_out in read_parts(LEFT_OUT, artifact.vocabulary):
            reader = _trained_without(left_out, artifact, settings, root) if train else artifact
            labels += [artifact.vocabulary.labels[index] for index in left_out.tolist()]
            vectors = vectors_of(artifact.vocabulary, left_out, aliases=aliases)
            tables = measure(artifact, reader, lists, left_out, vectors)
            for total, part in zip((auc, mrr), tables, strict=True):
                for name, values in part.items():
                    total[name] += values
        results = {"classes": labels, "auc": auc, "mrr": mrr}
        write_whole(folder / "results.json", json.dumps(results, indent=1))
        count = len(lists.listed)
        console.print(f"{len(labels)} classes, {count // _LISTS} scenes, {count} lists")
        for title, table in (("AUC", auc), ("MRR of hidden classes", mrr)):
            for line in summary(title, table):
                console.print(line, highlight=False)


def summary(title: str, values: dict[str, list[float]]) -> list[str]:
    """Return the mean of each method with its interval over the classes, as lines."""
    table = {name: np.array(column) for name, column in values.items()}
    has_lists = np.isfinite(table["predicted"])
    means = {name: Ratio.of_scenes(column[has_lists]) for name, column in table.items()}
    lead = paired_difference(means["predicted"], means["nearest class"])
    lines = [f"{title}, mean over {int(has_lists.sum())} classes:"]
    lines += [f"  {name:24} {mean.figure()}" for name, mean in means.items()]
    return [*lines, f"  {'predicted - nearest class':24} {lead}"]


def read_parts(path: Path, vocabulary: Vocabulary) -> list[Int[NDArray, " n"]]:
    """Return the indices of the classes of each part of a table of parts and labels.

    Raises:
        ConfigError: the model does not have a class of the table.
    """
    parts = defaultdict[str, list[int]](list)
    with path.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            if row["label"] not in vocabulary.labels:
                raise ConfigError(f"{path.name}: the model has no class {row['label']!r}")
            parts[row["part"]].append(vocabulary.labels.index(row["label"]))
    return [np.array(classes) for classes in parts.values()]


def measure(
    artifact: SceneModel,
    reader: SceneModel,  # reads the left-out classes as words; `artifact`, or one without them
    lists: Lists,
    left_out: Int[NDArray, " n"],
    vectors: Float[NDArray, "n dimensions"],
) -> tuple[dict[str, list[float]], dict[str, list[float]]]:
    """Return the AUC of each left-out class by `METHODS`, and the MRR by `EVIDENCE`."""
    vocabulary, labels = reader.vocabulary, artifact.vocabulary.labels
    index_of = {label: index for index, label in enumerate(vocabulary.labels)}
    own = np.array([index_of.get(label, -1) for label in labels])  # classes of `reader`, -1: none
    unseen = own[left_out][own[left_out] >= 0].tolist()
    words = [labels[index] for index in left_out.tolist()]
    new = [_word(*word, vocabulary, unseen) for word in zip(words, vectors, strict=True)]
    weights = RowMap.fit(reader.weights, vocabulary, unseen).with_words(reader.weights, new)
    listed = [own[classes][own[classes] >= 0] for classes in lists.listed]
    columns = np.arange(len(vocabulary), len(vocabulary) + len(new))
    nearest = np.array([word.nearest for word in new])
    of_words = log_odds(weights, listed, np.concatenate([columns, nearest]))
    trained = log_odds(artifact.weights, lists.listed, left_out)
    length = np.repeat([[float(len(x))] for x in lists.listed], len(left_out), axis=1)
    n = len(left_out)
    scores = (of_words[:, :n], of_words[:, n:], trained, length)
    auc = [lists.auc(values, left_out).tolist() for values in scores]
    things = np.flatnonzero(~artifact.vocabulary.structure & (own >= 0))
    mrr: dict[str, list[float]] = {name: [] for name in EVIDENCE}
    for k, index in enumerate(left_out.tolist()):
        rows = np.flatnonzero(lists.shows[:, index])[:_SHOWN]
        rest = [lists.listed[row][lists.listed[row] != index] for row in rows]
        without = [own[classes][own[classes] >= 0] for classes in rest]
        with_word, with_nearest = (
            [np.union1d(classes, [added[k]]) for classes in without] for added in (columns, nearest)
        )
        for name, machine, parts, targets in (
            ("predicted", weights, with_word, own[things]),
            ("nearest class", weights, with_nearest, own[things]),
            ("trained", artifact.weights, [lists.listed[row] for row in rows], things),
            ("left out", weights, without, own[things]),
        ):
            mrr[name].append(lists.mrr(log_odds(machine, parts, targets), rows, things))
    return dict(zip(METHODS, auc, strict=True)), mrr


def vectors_of(
    vocabulary: Vocabulary, left_out: Int[NDArray, " n"], *, aliases: bool
) -> Float[NDArray, "n dimensions"]:
    """Return the word vectors of the labels of some classes, or of the labels and aliases.

    Raises:
        ConfigError: a label has no word vector.
    """
    vectors = []
    for index in left_out.tolist():
        label = vocabulary.labels[index]
        if (vector := word_vectors().of(label)) is None:
            raise ConfigError(f"the word {label!r} has no word vector")
        vectors.append(vocabulary.vectors[0][index] if aliases else vector)
    return np.stack(vectors)


def _word(
    label: str, vector: Float[NDArray, " d"], vocabulary: Vocabulary, unseen: Sequence[int]
) -> Word:
    """Return a label as a word of its own, which no unseen class may explain."""
    vectors, has_vector = vocabulary.vectors
    usable = has_vector & ~vocabulary.structure
    usable[list(unseen)] = False
    cosines = np.where(usable, vectors @ vector, -1.0)
    return Word(label, vector, int(cosines.argmax()), float(cosines.max()))


_scorer_of = lru_cache(maxsize=4)(ObjectScorer)  # the log-odds of a machine, prepared once


def log_odds(
    weights: Weights, listed: Sequence[Int[NDArray, " k"]], columns: Int[NDArray, " n"]
) -> Float[NDArray, "lists n"]:
    """Return the log-odds of some classes given each list."""
    scorer, scores = _scorer_of(weights), np.zeros((len(listed), len(columns)))
    for row, classes in enumerate(listed):
        x = weights["c1"] + weights["W"][classes].sum(0)
        presence = np.ones(len(classes), np.float32)
        scores[row] = scorer.absent(x, classes, presence, None, coverage=0.5)[columns]
    return scores


def _trained_without(
    left_out: Int[NDArray, " n"], artifact: SceneModel, config: Config, root: Path
) -> SceneModel:
    """Train a model without some classes. Their kinds have no parent."""
    original = artifact.vocabulary
    labels = {original.labels[index] for index in left_out.tolist()}
    kept = [
        replace(entry, parent=None) if entry.parent in labels else entry
        for entry in original.objects
        if entry.label not in labels
    ]
    vocabulary = Vocabulary(kept, original.room_types, original.room_aliases)
    data = prepare(config, root, vocabulary).training_data()
    return draft_artifact(Trainer(config, data).run().machine, vocabulary)
