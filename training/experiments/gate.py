"""Decide whether a new version may replace the version that an alias serves.

Both versions are compared on common held-out scenes (see compare.py). The new version is refused if
a primary metric is lower by more than the margin, over the whole interval of the paired difference.
Smaller or uncertain losses are accepted. The new version is also refused if the served version was
measured on relation tasks and the comparison contains none.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from app.registry import Artifact, ArtifactError, Store, StoreError
from app.registry.references import AliasTarget
from training.experiments.compare import Comparison, compare
from training.experiments.sides import Say, Side, stored_side
from training.pipeline import SplitScenes
from training.runs import FinishedRun

# Accepted loss of a primary metric when a new version replaces the served version.
MARGIN = 0.02


class WorseError(RuntimeError):
    """The new version is refused: it is worse than the served version, or lacks relation metrics.

    Attributes:
        comparison: comparison of the new version with the served version.
    """

    def __init__(self, comparison: Comparison, margin: float) -> None:
        a, b, reasons = comparison.a, comparison.b, []
        if rows := comparison.worse_by(margin):
            names = ", ".join(f"{row.task} {row.metric} ({row.figure})" for row in rows)
            reasons.append(f"{a} is worse than {b} by more than {margin}: {names}")
        if comparison.unmeasured:
            names = ", ".join(comparison.unmeasured)
            reasons.append(
                f"{b} was measured in {names}, but {a} was not, because the compared scenes "
                "contain no relations"
            )
        super().__init__("; ".join(reasons))
        self.comparison = comparison


@dataclass(frozen=True)
class Seat:
    """An alias of the model store, and the model that it serves now.

    Attributes:
        alias: name of the alias.
        target: model version that the alias names now. None if the alias is new.
        holder: the served model. None if the alias is new or the model cannot be read.
        note: reason why a comparison with the served model is impossible, or "".
    """

    alias: str
    target: AliasTarget | None
    holder: Side | None
    note: str


def seat(store: Store, alias: str) -> Seat:
    """Look up an alias in the store and load the model that it serves.

    Raises:
        StoreError: the aliases of the store cannot be read.
    """
    target = store.aliases().get(alias)
    if target is None:
        return Seat(alias, None, None, f"no comparison: {alias} is a new alias and serves no model")
    try:
        return Seat(alias, target, stored_side(alias, store), "")
    except (ArtifactError, StoreError) as error:
        note = f"no comparison: the model served as {alias} cannot be read ({error})"
        return Seat(alias, target, None, note)


def judge(
    run: FinishedRun,
    scenes: SplitScenes,
    artifact: Artifact,
    holder: Side,
    root: Path,
    *,
    margin: float,
    limit: int | None,
    say: Say,
) -> Comparison:
    """Compare a new version with the served version before publication.

    Args:
        artifact: the new version.
        holder: the served version.
        root: folder with the scene files of the run.
        margin: accepted loss of a primary metric.
        limit: maximum number of scenes.

    Raises:
        WorseError: the new version is worse, or it is not measured on relation tasks.
        ConfigError: the comparison is impossible, see `compare`.
    """
    new = Side("the new version", run.config, scenes.digests, artifact, root)
    comparison = compare(new, holder, root, limit=limit, examples=3, say=say)
    if comparison.worse_by(margin) or comparison.unmeasured:
        raise WorseError(comparison, margin)
    return comparison
