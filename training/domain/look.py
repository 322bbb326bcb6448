"""Statistics of scenes, and what the user should check: labels, contradictions, unusable data."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from rapidfuzz import process
from rapidfuzz.distance import OSA

from app.scene import CANONICAL, canonicalise, label_key
from app.scene.scene import LARGEST, MOST_DISTANT
from app.scene.spatial_relations import ABOVE, ON_TOP
from training.datasets import AnnotatedScene, EncodedScene
from training.datasets.sources import source_of
from training.datasets.vocabulary import curated_names, most_frequent
from training.domain.conventions import likely_convention

SHOWN = 5  # maximum number of examples in a finding; further cases are only counted


@dataclass(frozen=True)
class Finding:
    """A property of the scenes that the user should check."""

    what: str  # description of the property, in one sentence
    advice: str  # recommended action of the user
    count: int  # number of cases
    examples: list[str]  # the first `SHOWN` cases


@dataclass(frozen=True)
class Facts:
    """Statistics of a set of scenes."""

    scenes: int
    groups: int  # of near-duplicates
    objects_per_scene: tuple[int, float, int]  # minimum, mean and maximum
    rooms: dict[str, int]  # number of scenes of each canonical room type
    annotated: dict[str, float]  # share of scenes with each kind of annotation, such as "positions"
    findings: tuple[Finding, ...]

    @property
    def related(self) -> bool:
        """True if a model can learn relations from the scenes."""
        sources = ("relations", "positions", "supports", "boxes in an image")
        return any(self.annotated[name] > 0 for name in sources)


def look(scenes: Sequence[AnnotatedScene], labels: Sequence[Label]) -> Facts:
    """Compute the statistics and findings of scenes, at least one, and of their labels."""
    sizes = [len(scene.objects) for scene in scenes]
    canonical = [curated_names().canonical_room(scene.room_type) for scene in scenes]
    rooms = Counter(room for room in canonical if room is not None)

    def share(attribute: str) -> float:
        return sum(any(getattr(t, attribute) for t in s.objects) for s in scenes) / len(scenes)

    return Facts(
        scenes=len(scenes),
        groups=len({scene.group for scene in scenes}),
        objects_per_scene=(min(sizes), sum(sizes) / len(sizes), max(sizes)),
        rooms=dict(rooms.most_common()),
        annotated={
            "room type": rooms.total() / len(scenes),
            "relations": sum(bool(scene.relations) for scene in scenes) / len(scenes),
            "positions": share("position"),
            "sizes": share("size"),
            "supports": share("supported_by"),
            "boxes in an image": share("box2d"),
            "viewer axes": sum(scene.viewer_frame for scene in scenes) / len(scenes),
        },
        findings=tuple(x for x in _findings(scenes, labels, rooms) if x.count),
    )


def _findings(
    scenes: Sequence[AnnotatedScene], labels: Sequence[Label], rooms: Counter[str]
) -> Iterator[Finding]:
    """Generate the findings. A finding without cases has the count 0."""

    def finding(what: str, advice: str, cases: Iterable[str]) -> Finding:
        examples = list(cases)
        return Finding(what, advice, len(examples), examples[:SHOWN])

    triples_of = [{canonicalise(*triple) for triple in s.relations or ()} for s in scenes]
    listed = list(zip(scenes, triples_of, strict=True))
    yield finding(
        "Scenes have fewer than two different objects, so they do not show co-occurrence.",
        "Training reads them. Questions that need more objects skip them.",
        (s.scene_id for s in scenes if len({label_key(thing.label) for thing in s.objects}) < 2),
    )
    yield finding(
        "A relation is annotated in both directions, such as left and right of each other.",
        "Such a relation counts as unobserved. Correct it, or check the point of view.",
        (
            f"{_describe_pair(scene, i, j)}, {CANONICAL[a]}"
            for scene, triples in listed
            for a, i, j in sorted(triples)
            if i < j and (a, j, i) in triples
        ),
    )
    yield finding(
        "An object is on-top of another object that is annotated as above it.",
        "Correct one of the two relations.",
        (
            _describe_pair(scene, i, j)
            for scene, triples in listed
            for a, i, j in sorted(triples)
            if a == ON_TOP and (ABOVE, j, i) in triples
        ),
    )
    yield finding(
        "Two labels differ by one or two letters.",
        "If one of them is a typing error, correct the scenes, or merge the classes in "
        "vocabulary.json.",
        (
            f"{rare.name} ({rare.mentions}) and {frequent.name} ({frequent.mentions})"
            for rare, frequent in similar_labels(labels)
        ),
    )
    yield finding(
        "Scenes of different groups have the same objects in the same places or relations.",
        "Remove copies or put them into one group. Otherwise test scenes occur in training.",
        _duplicates(scenes),
    )
    seen = [scene for scene in scenes if not source_of(scene.source).written]
    one_scene_each = len({scene.group for scene in seen}) == len(seen)
    yield Finding(
        "Every scene has its own group.",
        "If several scenes are frames or scans of one place, put these scenes into one group. "
        "Near-duplicates in training and test scenes make the test results too good.",
        len(seen) if one_scene_each else 0,
        [],
    )
    yield finding(
        "Scenes have no room type.",
        "Room types are optional; known room types make the answers more accurate.",
        (scene.scene_id for scene in scenes if rooms and scene.room_type is None),
    )
    yield finding(
        "Scenes with positions do not state that the positions are in viewer axes.",
        "Left and front are derived from a viewpoint on one side of the room, which depends on the "
        'scene id. If x is away from the viewer, y left and z up, set "viewer_frame": true.',
        (
            scene.scene_id
            for scene in scenes
            if scene.relations is None
            and not scene.viewer_frame
            and any(thing.position for thing in scene.objects)
        ),
    )
    yield of_convention(scenes)
    yield finding(
        f"Positions are beyond {MOST_DISTANT:g} m, or sides of objects beyond {LARGEST:g} m.",
        "Positions and sizes must be in metres, or in the declared `units`.",
        (scene.scene_id for scene in scenes if _beyond_metres(scene)),
    )


def of_convention(scenes: Iterable[AnnotatedScene]) -> Finding:
    """Return the finding about the conventions of the boxes of scenes."""
    reading, cases = likely_convention(scenes)
    what = "The boxes of scenes probably follow another convention."
    advice = "" if reading is None else f"{reading.message[0].upper()}{reading.message[1:]}."
    return Finding(what, advice, len(cases), [scene.scene_id for scene in cases[:SHOWN]])


def _beyond_metres(scene: AnnotatedScene) -> bool:
    """Return True if a position or a side is too large to be in metres."""
    points = np.array([thing.position for thing in scene.objects if thing.position] or [(0, 0, 0)])
    middle = np.zeros(3) if scene.viewer_frame else np.median(points, 0)
    sides = [side for thing in scene.objects for side in thing.size or ()]
    far = np.linalg.norm(points - middle, axis=1).max() > MOST_DISTANT
    return bool(far or max(sides, default=0) > LARGEST)


def _describe_pair(scene: AnnotatedScene, i: int, j: int) -> str:
    a, b = scene.objects[i], scene.objects[j]
    return f"{scene.scene_id}: {a.label} ({a.id}) and {b.label} ({b.id})"


def _duplicates(scenes: Sequence[AnnotatedScene]) -> Iterator[str]:
    """Generate pairs of scenes with the same objects and relations, but different groups."""
    first_scene: dict[object, AnnotatedScene] = {}
    for scene in scenes:
        labels = {thing.id: label_key(thing.label) for thing in scene.objects}
        things = [
            (
                labels[thing.id],
                thing.position and tuple(round(x, 3) for x in thing.position),
                thing.box2d,
                thing.supported_by and labels[thing.supported_by],
            )
            for thing in scene.objects
        ]
        if not scene.relations and not any(any(placed) for _, *placed in things):
            continue  # two small scenes often have the same objects by chance
        content = (tuple(sorted(things, key=repr)), tuple(sorted(scene.relations or ())))
        earlier = first_scene.setdefault(content, scene)
        if earlier.group != scene.group:
            yield f"{earlier.scene_id} and {scene.scene_id}"


_COMPARED = 2000  # maximum number of compared names, most frequent first
_ONE_SLIP, _TWO_SLIPS = 5, 10  # minimum letters of names that differ by one edit, or by two
_SHOWN = 8  # labels in the text of `outside_vocabulary`; further labels are only counted


@dataclass(frozen=True)
class Label:
    """One name of objects, with all its spellings."""

    name: str  # curated name, or the most frequent spelling
    mentions: int  # number of objects with this name
    spellings: tuple[str, ...]  # most frequent first


def outside_vocabulary(scenes: Iterable[EncodedScene]) -> str:
    """Return one line that names the labels outside the vocabulary, "" without any."""
    with_labels = [scene.unknown for scene in scenes if scene.unknown]
    spellings: dict[str, Counter[str]] = {}
    for label, count in Counter(label for labels in with_labels for label in labels).items():
        spellings.setdefault(label_key(label), Counter())[label] += count
    if not spellings:
        return ""
    counts = [(-spelt.total(), most_frequent(spelt)) for spelt in spellings.values()]
    listed = [f'"{label}" ({_number(-count, "scene")})' for count, label in sorted(counts)[:_SHOWN]]
    listed += [f"{len(counts) - _SHOWN:,} more"] if len(counts) > _SHOWN else []
    are, they = ("is", "it is") if len(counts) == 1 else ("are", "they are")
    return (
        f"{_number(len(counts), 'label')} in {_number(len(with_labels), 'scene')} {are} not in "
        f"the vocabulary: {', '.join(listed)}; {they} left out"
    )


def _number(count: int, noun: str) -> str:
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def count_labels(scenes: Iterable[AnnotatedScene]) -> list[Label]:
    """Count all names, most frequent first. Spellings with the same key count as one name."""
    spellings: defaultdict[str, Counter[str]] = defaultdict(Counter)
    names_of: defaultdict[str, Counter[str]] = defaultdict(Counter)
    canonical = cache(curated_names().canonical)
    for thing in (thing for scene in scenes for thing in scene.objects):
        name = canonical(thing.label)
        key = label_key(name)
        spellings[key][thing.label] += 1
        names_of[key][name] += 1
    labels = []
    for key, counts in spellings.items():
        spelt = tuple(sorted(counts, key=lambda label: (-counts[label], label)))
        labels.append(Label(most_frequent(names_of[key]), counts.total(), spelt))
    return sorted(labels, key=lambda label: (-label.mentions, label.name))


def similar_labels(labels: Sequence[Label]) -> Iterator[tuple[Label, Label]]:
    """Generate pairs (rarer, more frequent) of names that differ by a likely typing error.

    The names differ by one edit, or by two edits if long. Two curated names, or two names with
    different digits, are different objects and form no pair.
    """
    compared = [label for label in labels[:_COMPARED] if len(label_key(label.name)) >= _ONE_SLIP]
    keys = [label_key(label.name) for label in compared]
    names = curated_names()
    curated = {label_key(name) for name in (*names.base, *names.aliases, *names.structure)}
    for i, key in enumerate(keys):
        slips = 2 if len(key) >= _TWO_SLIPS else 1
        for other, _, offset in process.extract(
            key, keys[i + 1 :], scorer=OSA.distance, limit=None, score_cutoff=slips
        ):
            digits = {"".join(filter(str.isdigit, text)) for text in (key, other)}
            if len(digits) == 1 and not {key, other} <= curated:
                # Labels are sorted by frequency.
                yield compared[i + 1 + offset], compared[i]
