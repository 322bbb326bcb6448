"""Split scenes into training, test and validation parts by one of five protocols.

The percentages are the shares of the training, test and validation part.

- ``group`` (75 / 15 / 10 %) puts all scenes of a group of near-duplicates into one part. A group
  can occur in several data sources, for example as a camera frame and as 3D boxes of the same
  frame. The group then has the same part in all these sources.
- ``stable`` (75 / 15 / 10 %) derives the part of a group only from the seed and the group name.
  All groups keep their parts when a data set grows. A later model version is therefore never
  trained on the test scenes of an earlier version. This protocol does not stratify.
- ``final`` (90 / 0 / 10 %) is ``group`` without a test part. The shipped weights are trained on the
  90 % and calibrated on the 10 %.
- ``paper`` (60 / 30 / 10 %) is the protocol of Bozcan et al. (ICRA 2018). Each scene is assigned
  separately.
- ``paper groups`` has the shares of ``paper`` and keeps groups together.

All protocols except ``stable`` stratify by room type. Their parts depend on the seed and on the set
of scenes, but not on the order of scenes. Data sources without a common group do not affect each
other's parts. Data sources with common groups must be split together.
"""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Final, Literal

from training.datasets.names import curated_names
from training.datasets.records import AnnotatedScene

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
    """Return the scenes of each part, in their original order.

    Raises:
        ValueError: the protocol is unknown, or two scenes of a data source have the same id.
    """
    if protocol not in FRACTIONS:
        raise ValueError(f"protocol must be one of {', '.join(FRACTIONS)}, not {protocol!r}")
    if len({(scene.source, scene.scene_id) for scene in scenes}) < len(scenes):
        raise ValueError(
            "two scenes of one source have the same scene_id; give each scene a distinct id"
        )
    # All scenes of a unit have the same part.
    units = [
        f"{scene.source}/{scene.scene_id}" if protocol == "paper" else scene.group
        for scene in scenes
    ]
    part_of: dict[str, Part] = {}
    if protocol == "stable":
        part_of = {unit: stable_part(unit, seed) for unit in units}
    else:
        for family in _families(scenes, units):
            part_of |= _assign(family, FRACTIONS[protocol], seed)
    parts: dict[Part, list[AnnotatedScene]] = {part: [] for part in FRACTIONS[protocol]}
    for scene, unit in zip(scenes, units, strict=True):
        parts[part_of[unit]].append(scene)
    return parts


def stable_part(group: str, seed: int) -> Part:
    """Return the part of a group in the ``stable`` protocol. It depends on no other scenes."""
    fraction = int.from_bytes(_rank(seed, group)[:8], "big") / 2**64
    for part, share in FRACTIONS["stable"].items():
        if fraction < share:
            return part
        fraction -= share
    return "train"


def _families(
    scenes: Sequence[AnnotatedScene], units: Sequence[str]
) -> list[dict[str, Counter[str]]]:
    """Count the room types of each unit (group or scene), for each set of connected data sources.

    Data sources are connected if they have common units. A unit is counted only in its largest
    source, so that a small source cannot change the parts of a large source.
    """
    sources_of: dict[str, set[str]] = defaultdict(set)
    sizes: Counter[str] = Counter()
    for scene, unit in zip(scenes, units, strict=True):
        sources_of[unit].add(scene.source)
        sizes[scene.source] += 1
    family_of = _component_of(sizes, sources_of.values())
    leading = {
        unit: max(sources, key=lambda source: (sizes[source], source))
        for unit, sources in sources_of.items()
    }
    families: dict[str, dict[str, Counter[str]]] = {}
    names = curated_names()
    for scene, unit in zip(scenes, units, strict=True):
        if scene.source == leading[unit]:
            family = families.setdefault(family_of[scene.source], {})
            room = names.canonical_room(scene.room_type) or ""
            family.setdefault(unit, Counter())[room] += 1
    return list(families.values())


def _component_of(sources: Iterable[str], shared: Iterable[set[str]]) -> dict[str, str]:
    """Map each data source to the alphabetically first source of its connected component."""
    family = {source: source for source in sources}
    for linked in shared:
        if len(linked) > 1:
            old = {family[source] for source in linked}
            new = min(old)
            family = {source: new if name in old else name for source, name in family.items()}
    return family


def _assign(
    rooms_of: Mapping[str, Counter[str]], shares: Mapping[Part, float], seed: int
) -> dict[str, Part]:
    """Assign each unit to the part that is furthest below its target share of scenes.

    The stratum of a unit is its most common room type. Large strata are assigned first, and a hash
    orders the units within a stratum. The distance from the target is the sum of two distances:
    within the stratum and over all scenes. Otherwise, all units of small strata would become
    training scenes.
    """
    strata: dict[str, list[str]] = defaultdict(list)
    for unit, rooms in rooms_of.items():
        strata[min(rooms, key=lambda room: (-rooms[room], room))].append(unit)
    weight = {unit: rooms.total() for unit, rooms in rooms_of.items()}
    overall: Counter[Part] = Counter()
    part_of: dict[str, Part] = {}
    for room in sorted(strata, key=lambda room: (-sum(weight[u] for u in strata[room]), room)):
        in_stratum: Counter[Part] = Counter()
        for unit in sorted(strata[room], key=lambda unit: _rank(seed, unit)):
            part = max(
                shares,
                key=lambda p: (
                    _lack(shares[p], in_stratum[p], in_stratum.total() + weight[unit])
                    + _lack(shares[p], overall[p], overall.total() + weight[unit])
                ),
            )
            part_of[unit] = part
            in_stratum[part] += weight[unit]
            overall[part] += weight[unit]
    return part_of


def _lack(share: float, assigned: int, total: int) -> float:
    """Return the number of additional scenes with which a part reaches its target share."""
    return share * total - assigned


def _rank(seed: int, unit: str) -> bytes:
    return hashlib.sha256(f"{seed}|{unit}".encode()).digest()
