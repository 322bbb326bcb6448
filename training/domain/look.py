"""What there is in a set of scenes, and what in it contradicts itself or will not be learnt."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

from app.scene import CANONICAL, canonicalise, label_key
from training.datasets import AnnotatedScene, Names

_ON_TOP, _ABOVE = CANONICAL.index("on-top"), CANONICAL.index("above")

# So many of each kind are shown; all of them are counted.
SHOWN = 5

# Of a label in a request: `scene_client.schemas.Label`, which training does without.
LONGEST = 100


@dataclass
class Finding:
    """Something that somebody should look at.

    Attributes:
        what: in a sentence.
        count: how often; examples: of which the first few.
        advice: what to do about it.
    """

    what: str
    advice: str
    count: int = 0
    examples: list[str] = field(default_factory=list)

    def add(self, example: str) -> None:
        """One more of them."""
        self.count += 1
        if len(self.examples) < SHOWN:
            self.examples.append(example)


@dataclass(frozen=True)
class Facts:
    """Counts over a set of scenes; shares are of all scenes.

    Attributes:
        scenes, groups, objects: how many.
        objects_per_scene: smallest, mean and largest.
        rooms: scenes by room type, as the vocabulary would spell it.
        shares: of scenes with a room type, with relations, with positions, with sizes, with
            supports, with boxes in an image, in viewer axes.
        relations: annotated triples by relation.
        findings: what to look at, those that never occurred left out.
    """

    scenes: int
    groups: int
    objects: int
    objects_per_scene: tuple[int, float, int]
    rooms: dict[str, int]
    shares: dict[str, float]
    relations: dict[str, int]
    findings: tuple[Finding, ...]

    @property
    def related(self) -> bool:
        """There is something to learn relations from."""
        sources = ("relations", "positions", "supports", "boxes in an image")
        return any(self.shares[name] > 0 for name in sources)


def look(scenes: Sequence[AnnotatedScene], names: Names) -> Facts:
    """Count and check.

    Raises:
        ValueError: there is no scene.
    """
    if not scenes:
        raise ValueError("there is no scene")
    sizes = [len(scene.objects) for scene in scenes]
    rooms = Counter(
        room for scene in scenes if (room := names.canonical_room(scene.room_type)) is not None
    )
    return Facts(
        scenes=len(scenes),
        groups=len({scene.group for scene in scenes}),
        objects=sum(sizes),
        objects_per_scene=(min(sizes), sum(sizes) / len(sizes), max(sizes)),
        rooms=dict(rooms.most_common()),
        shares=_shares(scenes, names),
        relations=dict(
            Counter(r for scene in scenes for _, r, _ in scene.relations or ()).most_common()
        ),
        findings=tuple(finding for finding in _findings(scenes, rooms, names) if finding.count),
    )


def _shares(scenes: Sequence[AnnotatedScene], names: Names) -> dict[str, float]:
    def share(has: Iterable[bool]) -> float:
        return sum(has) / len(scenes)

    return {
        "room type": share(names.canonical_room(scene.room_type) is not None for scene in scenes),
        "relations": share(bool(scene.relations) for scene in scenes),
        "positions": share(any(thing.position for thing in scene.objects) for scene in scenes),
        "sizes": share(any(thing.size for thing in scene.objects) for scene in scenes),
        "supports": share(any(thing.supported_by for thing in scene.objects) for scene in scenes),
        "boxes in an image": share(any(thing.box2d for thing in scene.objects) for scene in scenes),
        "viewer axes": share(scene.viewer_frame for scene in scenes),
    }


def _findings(
    scenes: Sequence[AnnotatedScene], rooms: Counter[str], names: Names
) -> Iterator[Finding]:
    small = Finding(
        "Scenes of fewer than two different things teach nothing of what belongs together.",
        "They are read and skipped where they cannot be asked about.",
    )
    both_ways = Finding(
        "Pairs are related both ways round (left and right of each other, say).",
        "Such a pair counts as unobserved. Correct it, or check whose left is meant.",
    )
    crossed = Finding(
        "Something is on top of a thing that is said to be above it.",
        "Correct one of the two.",
    )
    cycles = Finding(
        "Things carry each other in a circle (on-top, or supported_by).",
        "Correct it: nothing can stand on what stands on it.",
    )
    for scene in scenes:
        if len({label_key(thing.label) for thing in scene.objects}) < 2:
            small.add(scene.scene_id)
        held = {canonicalise(s, r, o) for s, r, o in scene.relations or ()}
        for a, i, j in sorted(held):
            if i < j and (a, j, i) in held:
                both_ways.add(f"{_pair(scene, i, j)}, {CANONICAL[a]}")
            if a == _ON_TOP and (_ABOVE, j, i) in held:
                crossed.add(_pair(scene, i, j))
        if (circle := _circle(scene, held)) is not None:
            cycles.add(f"{scene.scene_id}: {', '.join(circle)}")
    yield from (small, both_ways, crossed, cycles, _unaskable(scenes, names))
    yield _duplicates(scenes)
    yield _alone(scenes)
    nowhere = Finding(
        "Scenes have no room type.",
        "Room types are optional; where they are known they sharpen the answers.",
    )
    for scene in scenes:
        if scene.room_type is None:
            nowhere.add(scene.scene_id)
    if rooms:
        yield nowhere
    axes = Finding(
        "Scenes with positions do not say that these are in viewer axes.",
        "Left and front are derived as seen from one side of the room, chosen by the scene's id. "
        'If x is away from the viewer, y left and z up, say "viewer_frame": true.',
    )
    for scene in scenes:
        placed = any(thing.position for thing in scene.objects)
        if placed and scene.relations is None and not scene.viewer_frame:
            axes.add(scene.scene_id)
    yield axes


def _unaskable(scenes: Sequence[AnnotatedScene], names: Names) -> Finding:
    found = Finding(
        f"Labels are blank, longer than {LONGEST} characters or cannot be printed.",
        "No request can name such a thing. Give them other names.",
    )
    for label in sorted({thing.label for scene in scenes for thing in scene.objects}):
        name = names.canonical(label)
        if not name.strip() or len(name) > LONGEST or not name.isprintable():
            found.add(repr(label) if len(label) <= LONGEST else f"{label[:40]!r} …")
    return found


def _pair(scene: AnnotatedScene, i: int, j: int) -> str:
    a, b = scene.objects[i], scene.objects[j]
    return f"{scene.scene_id}: {a.label} ({a.id}) and {b.label} ({b.id})"


def _circle(scene: AnnotatedScene, held: set[tuple[int, int, int]]) -> list[str] | None:
    """The labels of things that carry each other in a circle of three or more, or by supports."""
    place = {thing.id: index for index, thing in enumerate(scene.objects)}
    below: dict[int, set[int]] = {}
    for a, i, j in held:
        # Two that are on each other are told of as a pair.
        if a == _ON_TOP and (a, j, i) not in held:
            below.setdefault(i, set()).add(j)
    for index, thing in enumerate(scene.objects):
        if thing.supported_by is not None:
            below.setdefault(index, set()).add(place[thing.supported_by])
    # Whoever stands on nothing that is left is in no circle.
    while free := [i for i, under in below.items() if not under & set(below)]:
        for i in free:
            del below[i]
    if not below:
        return None
    walk = [min(below)]
    while (following := min(below[walk[-1]] & set(below))) not in walk:
        walk.append(following)
    return [scene.objects[i].label for i in walk[walk.index(following) :]]


def _duplicates(scenes: Sequence[AnnotatedScene]) -> Finding:
    found = Finding(
        "Scenes of different groups have the same things in the same places or relations.",
        "Remove copies, or give them one group: otherwise what is tested on has been learnt.",
    )
    first: dict[object, AnnotatedScene] = {}
    for scene in scenes:
        things = [
            (label_key(thing.label), _rounded(thing.position), thing.box2d)
            for thing in scene.objects
        ]
        telling = scene.relations or any(place or box for _, place, box in things)
        if not telling:
            continue  # two small bathrooms may well hold the same
        content = (tuple(sorted(things, key=repr)), tuple(sorted(scene.relations or ())))
        other = first.setdefault(content, scene)
        if other.group != scene.group:
            found.add(f"{other.scene_id} and {scene.scene_id}")
    return found


def _rounded(position: tuple[float, float, float] | None) -> tuple[float, ...] | None:
    return None if position is None else tuple(round(value, 3) for value in position)


def _alone(scenes: Sequence[AnnotatedScene]) -> Finding:
    found = Finding(
        "Every scene is a group of its own.",
        "If several are frames or scans of one place, give these one group: near-duplicates on "
        "both sides of the split make a model look better than it is.",
    )
    if len({scene.group for scene in scenes}) == len(scenes):
        found.count = len(scenes)
    return found
