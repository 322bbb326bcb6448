"""Decide whether a new version may replace the version that an alias serves.

The new version is refused if the whole interval of a paired difference shows a loss larger than the
margin in a primary metric. Smaller or uncertain losses are accepted. If the served version was
measured on relations, the comparison must measure relations too.
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

# Accepted loss of a primary metric at a promotion.
MARGIN = 0.02


class WorseError(RuntimeError):
    """The new version is worse, or it is not measured on relations; see `comparison`."""

    def __init__(self, comparison: Comparison, margin: float) -> None:
        a, b, reasons = comparison.a, comparison.b, []
        if rows := comparison.worse_by(margin):
            names = ", ".join(f"{row.task} {row.metric} ({row.figure})" for row in rows)
            reasons.append(f"{a} is worse than {b} by more than {margin}: {names}")
        if comparison.unmeasured:
            names = ", ".join(comparison.unmeasured)
            reasons.append(
                f"the compared scenes contain no relations: {b} was measured in {names}, but {a} "
                "was not"
            )
        super().__init__("; ".join(reasons))
        self.comparison = comparison


@dataclass(frozen=True)
class Seat:
    """Current target of an alias.

    Attributes:
        alias: name of the alias.
        target: target of the alias; None for a new alias.
        holder: the served model; None if the alias is new or the model cannot be read.
        note: reason why a comparison is impossible, or "".
    """

    alias: str
    target: AliasTarget | None
    holder: Side | None
    note: str


def seat(store: Store, alias: str) -> Seat:
    """Look up an alias.

    Raises:
        StoreError: the aliases of the store cannot be read.
    """
    target = store.aliases().get(alias)
    if target is None:
        return Seat(alias, None, None, f"{alias} is a new alias: no model to compare with")
    try:
        return Seat(alias, target, stored_side(alias, store), "")
    except (ArtifactError, StoreError) as error:
        note = f"the model served as {alias} cannot be read ({error}): no model to compare with"
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

    Raises:
        WorseError: the version is worse, or it is not measured on relations.
        ConfigError: the comparison is impossible, see `compare`.
    """
    new = Side("the new version", run.config, scenes.digests, artifact, root)
    comparison = compare(new, holder, root, limit=limit, examples=3, say=say)
    if comparison.worse_by(margin) or comparison.unmeasured:
        raise WorseError(comparison, margin)
    return comparison
