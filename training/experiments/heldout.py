"""Which scenes neither of two models has learnt from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from training.config import ConfigError, DataConfig, source_name
from training.datasets import AnnotatedScene, DatasetError, split, stable_part
from training.experiments.sides import Side
from training.pipeline import digest_of, read_sources

# Whether a model was kept from a scene.
Kept = Callable[[AnnotatedScene], bool]


@dataclass(frozen=True)
class HeldOut:
    """Scenes to compare on.

    Attributes:
        scenes: test scenes of the first that the second has not learnt from either.
        dropped: how many of the first one's test scenes are left out.
        notes: what has to be said beside the figures.
        certain: nothing speaks for either having learnt from any of the scenes.
    """

    scenes: list[AnnotatedScene]
    dropped: int
    notes: tuple[str, ...]
    certain: bool


def held_out(
    a: Side, b: Side, sources: Mapping[str, Sequence[AnnotatedScene]], root: Path
) -> HeldOut:
    """The first one's test scenes, less what the second has learnt from.

    Args:
        sources: the scenes of the first one's configuration, by source, as they are now.
        root: the folder that they, and so perhaps the second one's, were read from.

    Raises:
        ConfigError: the first does not say how it was trained, or nothing is left.
    """
    if a.config is None:
        raise ConfigError(f"{a.title} does not say how its scenes were split")
    everything = [scene for some in sources.values() for scene in some]
    data = a.config.data
    candidates = split(everything, seed=data.split_seed, protocol=data.split)["test"]
    if not candidates:
        raise ConfigError("no scene is in the test part: take more scenes, or of more groups")
    notes: list[str] = []
    certain = True
    kept = candidates
    for side in (a, b):
        judge, note, sure = _kept(side, sources, root)
        if note:
            notes.append(note)
        certain &= sure
        kept = [scene for scene in kept if judge(scene)]
    dropped = len(candidates) - len(kept)
    if not kept:
        raise ConfigError(
            f"{b.title} has learnt from every test scene of {a.title}: nothing is held out for both"
        )
    if dropped:
        notes.append(
            f"{dropped} of {len(candidates)} test scenes of {a.title} are left out: {b.title} has "
            "learnt from them, or from scenes of their groups"
        )
    return HeldOut(kept, dropped, tuple(notes), certain)


def _kept(
    side: Side, sources: Mapping[str, Sequence[AnnotatedScene]], root: Path
) -> tuple[Kept, str, bool]:
    """Whether a side was kept from a scene, what to say of it, and whether that is certain."""
    if side.artifact is None:
        return _all, "", True  # fitted to the first one's own training scenes
    digests = {name: digest_of(some) for name, some in sources.items()}
    shared = {
        name
        for name, digest in digests.items()
        if name in side.learnt or digest in side.learnt.values()
    }
    if not shared:
        names = ", ".join(side.learnt) or "nothing it tells of"
        return _all, f"{side.title} learnt from other sources ({names})", True
    if side.config is None:
        note = f"{side.title} does not say how its scenes were split: it may have learnt from these"
        return _all, note, False
    data = side.config.data
    if data.split == "stable":
        seed = data.split_seed
        return (
            lambda scene: scene.source not in shared or stable_part(scene.group, seed) == "test",
            "",
            True,
        )
    if (own := _scenes_of(data, side.learnt, sources, digests, root)) is None:
        note = (
            f"{side.title} learnt from other versions of {', '.join(sorted(shared))}, and its "
            "split cannot be made again: it may have learnt from these (a split that is stable "
            "avoids this)"
        )
        return _all, note, False
    parts = split(own, seed=data.split_seed, protocol=data.split)
    # By group whatever the protocol: of whom a near-duplicate was learnt has been seen.
    learnt = {scene.group for part in ("train", "validation") for scene in parts[part]}
    return lambda scene: scene.group not in learnt, "", True


def _all(_: AnnotatedScene) -> bool:
    return True


def _scenes_of(
    data: DataConfig,
    learnt: Mapping[str, str],
    sources: Mapping[str, Sequence[AnnotatedScene]],
    digests: Mapping[str, str],
    root: Path,
) -> list[AnnotatedScene] | None:
    """The scenes that a side was split from, if they can be had as they were."""
    found: list[AnnotatedScene] = []
    for source in data.sources:
        name = source_name(source)
        if name in digests and digests[name] == learnt.get(name):
            found += sources[name]
            continue
        try:
            one = data.model_copy(update={"sources": (source,)})
            (read,) = read_sources(one, root).values()
        except (ConfigError, DatasetError):
            return None
        if digest_of(read) != learnt.get(name):
            return None
        found += read
    return found
