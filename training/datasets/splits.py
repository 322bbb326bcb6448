"""Split scenes into training, test and validation parts by one of five protocols.

The percentages are the shares of the training, test and validation part.

- ``group`` (75 / 15 / 10 %) puts all scenes of a group of near-duplicates into one part, also if
  several data sources contain the group.
- ``stable`` (75 / 15 / 10 %) derives the part of a group only from the seed and the group name, so
  all groups keep their parts when a data set grows. This protocol does not stratify.
- ``final`` (90 / 0 / 10 %) is ``group`` without a test part, for shipped weights.
  Both assign written scenes separately: otherwise the weights would miss whole written places.
- ``paper`` (60 / 30 / 10 %), of Bozcan et al. (ICRA 2018), assigns each scene separately.
- ``paper groups`` has the shares of ``paper`` and keeps groups together.

All protocols except ``stable`` stratify by room type, independent of the order of scenes and of the
vocabulary. Data sources with common groups must be split together; others are independent.
"""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from typing import Final, Literal

from training.datasets.records import AnnotatedScene
from training.datasets.sources import source_of
from training.datasets.vocabulary import curated_names

Part = Literal["train", "test", "validation"]
Protocol = Literal["group", "stable", "final", "paper", "paper groups"]

FRACTIONS: Final[dict[Protocol, dict[Part, float]]] = {
    "group": {"train": 0.75, "test": 0.15, "validation": 0.1},
    "stable": {"train": 0.75, "test": 0.15, "validation": 0.1},
    "final": {"train": 0.9, "test": 0.0, "validation": 0.1},
    "paper": {"train": 0.6, "test": 0.3, "validation": 0.1},
    "paper groups": {"train": 0.6, "test": 0.3, "validation": 0.1},
}


def split(
    scenes: Sequence[AnnotatedScene], *, seed: int, protocol: Protocol = "group"
) -> dict[Part, list[AnnotatedScene]]:
    """Return the scenes of each part, in their original order."""
    if protocol not in FRACTIONS:
        raise ValueError(f"protocol must be one of {', '.join(FRACTIONS)}, not {protocol!r}")
    if len({(scene.source, scene.scene_id) for scene in scenes}) < len(scenes):
        raise ValueError(
            "two scenes of one source have the same scene_id; give each scene a distinct id"
        )
    units = [_unit(scene, protocol) for scene in scenes]
    part_of: dict[str, Part] = {}
    if protocol == "stable":
        part_of = {_unit(scene, protocol): stable_part(scene, seed) for scene in scenes}
    else:
        for family in _families(scenes, units):
            part_of |= _assign(family, FRACTIONS[protocol], seed)
    parts: dict[Part, list[AnnotatedScene]] = {part: [] for part in FRACTIONS[protocol]}
    for scene, unit in zip(scenes, units, strict=True):
        parts[part_of[unit]].append(scene)
    return parts


def _unit(scene: AnnotatedScene, protocol: Protocol) -> str:
    """Return the name of the scenes that have the same part as a scene."""
    is_alone = protocol in ("stable", "final") and source_of(scene.source).written
    return f"{scene.source}/{scene.scene_id}" if protocol == "paper" or is_alone else scene.group


def stable_part(scene: AnnotatedScene, seed: int) -> Part:
    """Return the part of a scene in the ``stable`` protocol. It depends on no other scenes."""
    fraction = int.from_bytes(_rank(seed, _unit(scene, "stable"))[:8], "big") / 2**64
    for part, share in FRACTIONS["stable"].items():
        if fraction < share:
            return part
        fraction -= share
    return "train"


def _families(
    scenes: Sequence[AnnotatedScene], units: Sequence[str]
) -> Sequence[Mapping[str, Counter[str]]]:
    """Count the room types of each unit (scenes in one part), by sources that share units."""
    sources_of: dict[str, set[str]] = defaultdict(set)
    sizes: Counter[str] = Counter()
    for scene, unit in zip(scenes, units, strict=True):
        sources_of[unit].add(scene.source)
        sizes[scene.source] += 1
    # The name of a component is that of its alphabetically first source.
    family_of = {source: source for source in sizes}
    for linked in filter(lambda sources: len(sources) > 1, sources_of.values()):
        old = {family_of[source] for source in linked}
        family_of = {x: min(old) if name in old else name for x, name in family_of.items()}
    families: defaultdict[str, defaultdict[str, Counter[str]]]
    families = defaultdict(lambda: defaultdict(Counter))
    names = curated_names()
    for scene, unit in zip(scenes, units, strict=True):
        # Only in its largest source: a small source cannot change the parts of a large one.
        if scene.source == max(sources_of[unit], key=lambda source: (sizes[source], source)):
            room = names.canonical_room(scene.room_type) or ""
            families[family_of[scene.source]][unit][room] += 1
    return list(families.values())


def _assign(
    rooms_of: Mapping[str, Counter[str]], fractions: Mapping[Part, float], seed: int
) -> dict[str, Part]:
    """Assign each unit to the part that is furthest below its target share of scenes."""
    # The stratum of a unit is its most common room type. Large strata are assigned first.
    strata: dict[str, list[str]] = defaultdict(list)
    for unit, rooms in rooms_of.items():
        strata[min(rooms, key=lambda room: (-rooms[room], room))].append(unit)
    weight = {unit: rooms.total() for unit, rooms in rooms_of.items()}
    overall: Counter[Part] = Counter()
    part_of: dict[str, Part] = {}
    for room in sorted(strata, key=lambda room: (-sum(weight[u] for u in strata[room]), room)):
        in_stratum: Counter[Part] = Counter()
        for unit in sorted(strata[room], key=lambda unit: _rank(seed, unit)):
            # Number of additional scenes with which a part reaches its target share.
            lack = {
                part: sum(
                    fraction * (counts.total() + weight[unit]) - counts[part]
                    # Within the stratum alone, small strata would become training scenes.
                    for counts in (in_stratum, overall)
                )
                for part, fraction in fractions.items()
            }
            part_of[unit] = part = max(lack, key=lack.__getitem__)
            in_stratum[part] += weight[unit]
            overall[part] += weight[unit]
    return part_of


def _rank(seed: int, unit: str) -> bytes:
    return hashlib.sha256(f"{seed}|{unit}".encode()).digest()
