"""Whether a new version may take the place of the one that an alias serves.

It may not where a primary metric is worse by more than a margin, surely: where the whole interval
of the paired difference lies beyond it. A difference that could be chance stops nobody. Nor may it
where nothing shows how it does at relations, and what is served was measured at them.
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

# A primary metric may be worse by so much, surely, before a promotion is refused.
MARGIN = 0.02


class WorseError(RuntimeError):
    """A version that is, or may be, worse than the one it would replace; holds the comparison."""

    def __init__(self, comparison: Comparison, margin: float) -> None:
        a, b, reasons = comparison.a, comparison.b, []
        if rows := comparison.worse_by(margin):
            names = ", ".join(f"{row.task} {row.metric} ({row.figure})" for row in rows)
            reasons.append(f"{a} is worse than {b} by more than {margin}: {names}")
        if comparison.unmeasured:
            names = ", ".join(comparison.unmeasured)
            reasons.append(
                f"none of the scenes compared on tells of relations: nothing shows how {a} does at "
                f"{names}, at which {b} was measured"
            )
        super().__init__("; ".join(reasons))
        self.comparison = comparison


@dataclass(frozen=True)
class Seat:
    """What an alias points at now.

    Attributes:
        alias: its name; target: what it points at, None where it is new.
        holder: the model that it serves; None where there is none, or none that can be read.
        note: why there is nothing to compare with, else "".
    """

    alias: str
    target: AliasTarget | None
    holder: Side | None
    note: str


def seat(store: Store, alias: str) -> Seat:
    """Look up an alias.

    Raises:
        StoreError: the store's aliases cannot be read.
    """
    target = store.aliases().get(alias)
    if target is None:
        return Seat(alias, None, None, f"nothing is served as {alias} yet: nothing to compare with")
    try:
        return Seat(alias, target, stored_side(alias, store), "")
    except (ArtifactError, StoreError) as error:
        note = f"what {alias} serves cannot be read ({error}): nothing to compare with"
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
    """Compare a version that is about to be published with the one that is served.

    Args:
        artifact: as it would be published.

    Raises:
        WorseError: it is worse, or nothing shows how it does at relations.
        ConfigError: see `compare`.
    """
    new = Side("the new version", run.config, scenes.digests, artifact, root)
    comparison = compare(new, holder, root, limit=limit, examples=3, say=say)
    if comparison.worse_by(margin) or comparison.unmeasured:
        raise WorseError(comparison, margin)
    return comparison
