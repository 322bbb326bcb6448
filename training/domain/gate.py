"""Decide whether an alias may point at a new version.

First, the new version must be useful: `Usefulness.objections`. Then it is compared with the version
that the alias serves, on common held-out scenes: `Comparison.objections`.
docs/decisions/own-scenes.md gives the reasons for the rules.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from app.model import SceneModel
from app.registry import ArtifactError, Store, StoreError
from app.registry.references import AliasTarget
from training.datasets.batches import TrainingData, subset
from training.datasets.cases import some_scenes
from training.domain.candidates import Candidate, stored_candidate
from training.domain.compare import SCENES, difference_text
from training.evaluation.asking import score_missing
from training.evaluation.baselines import EASE, POPULARITY
from training.evaluation.metrics import FEWEST_GROUPS, Figure, Ratio, paired_difference
from training.evaluation.object_tasks import rank_missing
from training.evaluation.report import Progress
from training.evaluation.setting import ObjectScore

LEAST_LEAD = 0.02
"""Minimum lead of a new version over popularity, in MRR. A smaller lead is of no use, even if it is
certain: a model that is trained on shuffled labels can lead by 0.006."""

NEW = "the new version"
_REQUIRED = f"at least {LEAST_LEAD:+.3f}, whole interval above zero"


@dataclass(frozen=True)
class Usefulness:
    """A new version beside two baselines: MRR (mean reciprocal rank) of missing objects."""

    scenes: int
    groups: int  # of near-duplicates among the scenes
    # MRR of the new version and of each baseline, by name; empty with too few groups.
    mrr: Mapping[str, float] = field(default_factory=dict)
    differences: Mapping[str, Figure] = field(default_factory=dict)  # new version minus baseline

    def lines(self) -> Iterator[str]:
        """Generate the results as lines of at most 80 characters."""
        if not self.mrr:
            return
        yield f"mean reciprocal rank of a missing object, {self._sample_text()}:"
        for name, value in self.mrr.items():
            gap = self.differences.get(name)
            text = "" if gap is None else f"  difference {difference_text(gap)}"
            yield f"  {name:16} {value:.3f}{text}"
        yield f"  required over {POPULARITY.name}: {_REQUIRED}"

    def objections(self) -> list[str]:
        """Return the reasons against the new version; an empty list if it is useful."""
        if self.groups < FEWEST_GROUPS:
            return [
                f"{NEW} cannot be compared with {POPULARITY.name}: {self._sample_text()}, and a "
                f"comparison needs test scenes of at least {FEWEST_GROUPS} groups with two or more "
                "classes. Provide more scenes"
            ]
        reasons = []
        popularity, ease = self.differences[POPULARITY.name], self.differences[EASE.name]
        if not (popularity.value >= LEAST_LEAD and popularity.low > 0):
            reasons.append(
                f"{NEW} is not clearly better than {POPULARITY.name}, which only knows how "
                f"frequent each class is: difference {difference_text(popularity)} (required: "
                f"{_REQUIRED}), {self._sample_text()}. Check the labels, train longer or provide "
                "more scenes"
            )
        if ease.high < 0:
            reasons.append(
                f"{NEW} is worse than EASE, a plain model of co-occurrence: difference "
                f"{difference_text(ease)}, {self._sample_text()}"
            )
        return reasons

    def _sample_text(self) -> str:
        return f"{self.scenes} test scenes of {self.groups} groups"


def measure_usefulness(artifact: SceneModel, data: TrainingData, *, say: Progress) -> Usefulness:
    """Compare a new version with popularity and EASE on the scenes of its run.

    Test scenes with incomplete object lists are left out, unless all lists are incomplete.
    """
    complete = data.test.complete
    scenes = some_scenes(subset(data.test, complete) if complete.any() else data.test, SCENES)
    # A question hides one class and lists the others.
    scenes = subset(scenes, ((scenes.v > 0) & ~data.structure).sum(1) > 1)
    usefulness = Usefulness(scenes=len(scenes), groups=len(np.unique(scenes.group_ids)))
    if usefulness.groups < FEWEST_GROUPS:
        return usefulness

    def mrr(score: ObjectScore | None) -> Ratio:
        if score is None:
            raise ValueError("the model has no score of missing objects")
        return rank_missing(scenes, data.structure, score).mrr().by(scenes.group_ids)

    of_new, differences = mrr(partial(score_missing, artifact)), {}
    values = {NEW: of_new.value}
    for baseline in (POPULARITY, EASE):
        say(f"fitting {baseline.name}")
        other = mrr(baseline.fit(data.train, data.validation, data.structure).missing)
        values[baseline.name] = other.value
        differences[baseline.name] = paired_difference(of_new, other)
    return replace(usefulness, mrr=values, differences=differences)


class ServedModel(NamedTuple):
    """An alias of the model store, and the model that it serves now."""

    target: AliasTarget | None  # None if the alias is new
    candidate: Candidate | None  # None if the alias is new or the model cannot be read
    note: str  # reason why a comparison with the served model is impossible, or ""


def served_model(store: Store, alias: str) -> ServedModel:
    """Look up an alias in the store and load the model that it serves."""
    target = store.aliases().get(alias)
    if target is None:
        return ServedModel(None, None, f"{alias} is a new alias, so there is no older version")
    try:
        return ServedModel(target, stored_candidate(alias, store), "")
    except (ArtifactError, StoreError) as error:
        note = f"no comparison: the model served as {alias} cannot be read ({error})"
        return ServedModel(target, None, note)
