"""Tracks of things: which detections show one thing, whether the thing exists, and its label.

docs/moving.md describes the tracks. Positions are in metres in the frame ``map``, angles in
radians, and times in seconds.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from scene_client import schemas
from scene_client.calls import validated

Vector = tuple[float, float, float]
Point = tuple[float, float]

CELL: Final = 1.0
"""Width of a cell of the grid of tracks in metres, and the largest gate."""
MOST_CERTAIN: Final = 8.0
"""Upper limit of the log-odds of existence. After it, a gone thing needs at most 10 looks."""
MEMORY: Final = 20.0
"""Number of looks after which the mean of a position forgets older looks."""
UNCONFIRMED: Final = 60.0
"""Seconds without a detection after which an unconfirmed track ends."""
FARTHEST_SHIFT: Final = 2.5
"""Largest jump of the map in metres."""
SIMILAR: Final = 1.3
"""Largest ratio of the diagonals of two boxes that may be one thing with two labels."""
# Probability that a frame shows a thing of the room: known view, poses only, labels only.
FULL, POSES, LABELS = 1.0, 0.6, 0.25
_NEXT_TO: Final = math.radians(45)


@dataclass(frozen=True)
class Settings:
    """The settings of a `Home`. The defaults are measured (docs/moving.md).

    Attributes:
        hit_rate: probability that the detector reports a thing that the frame shows.
        false_rate: probability of a wrong detection at the place of an ended thing.
        prior: probability that the first detection at a place shows a thing.
        confirm: probability of existence from which a thing counts as present.
        gate: distance in metres between two detections of one small thing. A quarter of its largest
            side is added for a large thing.
        look: seconds between two independent looks. Frames at a higher rate count in proportion.
        hold: seconds in view until an alarm is raised or cleared.
        answers: looks until an alarm is raised or cleared.
        room_hold: seconds until the type of a room is settled or changes.
        pause: seconds between two questions.
        step: change of a probability, or of a position in metres, that needs a new answer.
        sensitivity: alarm rate of the service: low, medium or high.
        timeout: maximum time of a question in seconds.
        save_every: seconds between two writes of the file.
    """

    hit_rate: float = 0.7
    false_rate: float = 0.02
    prior: float = 0.1
    confirm: float = 0.8
    gate: float = 0.3
    look: float = 0.5
    hold: float = 3.0
    answers: int = 3
    room_hold: float = 5.0
    pause: float = 0.5
    step: float = 0.1
    sensitivity: schemas.Sensitivity = "medium"
    timeout: float = 1.0
    save_every: float = 10.0


@dataclass
class Latch:
    """A value that changes only after a while.

    The steps for a candidate must be ahead of all other steps by 1 (majority vote of Boyer and
    Moore). `since` is the time of the candidate's first step.
    """

    value: str | None = None
    candidate: str | None = None
    level: float = 0.0
    since: float = 0.0

    def update(self, value: str | None, now: float, step: float) -> bool:
        """Count one step for a value. Return whether the latch changes to this value."""
        if value == self.value or (value != self.candidate and self.level > step / 2):
            self.level = max(0.0, self.level - step)
            return False
        if value != self.candidate or self.level == 0:
            self.candidate, self.level, self.since = value, 0.0, now
        self.level += step
        if self.level < 1 - 1e-9:
            return False
        self.value, self.candidate, self.level = value, None, 0.0
        return True


@dataclass
class Seen:
    """One detection: the weight of each label, and its box."""

    labels: dict[str, float]
    place: Vector | None = None
    size: Vector | None = None
    yaw: float | None = None

    @property
    def confidence(self) -> float:
        """Probability that the detection shows a thing, with one of its labels."""
        return min(1.0, sum(self.labels.values()))


@dataclass
class Track:
    """One thing.

    Attributes:
        votes: sum of the confidences of each label.
        log_odds: ln(p / (1 - p)) of the probability p that the thing exists.
        looks: number of looks with a detection.
        missed: number of looks without a detection since the last detection.
        verdict: last answer of the service: does not belong, in a wrong place, wrong detection, or
            none of these. None without an answer.
        alarm: the alarm of the thing.
    """

    id: str
    room: str | None
    log_odds: float
    first: float
    last: float
    votes: dict[str, float] = field(default_factory=dict)
    place: Vector | None = None
    size: Vector | None = None
    yaw: float | None = None
    looks: float = 0.0
    missed: float = 0.0
    is_confirmed: bool = False
    verdict: str | None = None
    probability: float = 0.0
    alarm: Latch = field(default_factory=Latch)

    @property
    def label(self) -> str:
        """Label with the most votes."""
        return max(self.votes, key=self.votes.__getitem__)

    def share(self, label: str) -> float:
        """Return the share of a label in the votes."""
        return self.votes.get(label, 0.0) / sum(self.votes.values())

    @property
    def exists(self) -> float:
        """Probability that the thing exists."""
        return 1 / (1 + math.exp(-self.log_odds))

    def see(self, seen: Seen, now: float, weight: float) -> None:
        """Add the votes of a detection, and its box to the running mean."""
        for label, vote in seen.labels.items():
            self.votes[label] = self.votes.get(label, 0.0) + weight * vote
        self.looks += weight
        share = weight / min(self.looks, MEMORY)
        self.place = _mean(self.place, seen.place, share)
        self.size = _mean(self.size, seen.size, share)
        self.yaw = self.yaw if seen.yaw is None else seen.yaw
        self.last, self.missed = now, 0.0

    def likeness(self, seen: Seen) -> float:
        """Return the share of the detection's labels in the votes, from 0 to 1."""
        total = sum(seen.labels.values())
        return sum(w / total * self.share(label) for label, w in seen.labels.items())


@dataclass(frozen=True)
class Frame:
    """What one call of `Home.update` says.

    Attributes:
        weight: number of independent looks, from 0 to 1.
        pose: x, y and yaw of the robot.
        view: full horizontal angle of the camera, and its reach.
        room: room of the robot.
        is_walled: whether rooms bound the view.
    """

    seen: list[Seen]
    now: float
    weight: float
    pose: Vector | None
    view: Point | None
    room: str | None
    is_walled: bool


class Change(NamedTuple):
    """The track of each detection of a frame, new things, and ended things."""

    seen: list[Track]
    appeared: list[Track]
    gone: list[Track]


def read_detections(detections: Iterable[Any]) -> list[Seen]:
    """Return the detections of a frame.

    Raises:
        InvalidRequestError: a detection is invalid.
    """
    request = validated(schemas.SceneRequest, {"objects": list(detections)})
    return [
        Seen({one: 1.0})
        if isinstance(one, str)
        else Seen(
            dict(Counter({guess.label: guess.confidence for guess in one.alternatives}))
            | {one.label: one.confidence},
            _vector(one.position),
            _vector(one.size),
            _yaw(one),
        )
        for one in request.objects
    ]


class Tracks:
    """All tracks of a home.

    Args:
        settings: the settings.
        room_of: function that returns the room of a position and of the robot's room.
    """

    def __init__(
        self, settings: Settings, room_of: Callable[[Vector, str | None], str | None]
    ) -> None:
        self.settings = settings
        self.room_of = room_of
        self.all: dict[str, Track] = {}
        self.shift: Vector = (0.0, 0.0, 0.0)
        self.count = 0
        self._cells: dict[tuple[int, int], dict[str, Track]] = defaultdict(dict)

    def add(self, track: Track) -> None:
        """Add a track, also one from a file."""
        self.all[track.id] = track
        if track.place is not None:
            self._cells[_cell(track.place)][track.id] = track

    def remove(self, track: Track) -> None:
        """Remove a track."""
        del self.all[track.id]
        if track.place is not None:
            self._cells[_cell(track.place)].pop(track.id, None)

    def update(self, frame: Frame) -> Change:
        """Update the tracks with a frame.

        Existence is a log-odds filter. With the probability v that the frame shows the thing, the
        hit rate h and the false rate f, a hit of confidence c adds c ln(v h / f), and a miss adds
        ln((1 - v h) / (1 - f)), each times the number of looks.
        """
        s, view = self.settings, LookedAt(frame)
        seen = self._associate(frame)
        for track, one in zip(seen, frame.seen, strict=True):
            chance = LABELS if one.place is None else FULL
            gain = one.confidence * math.log(chance * s.hit_rate / s.false_rate)
            track.log_odds = min(MOST_CERTAIN, track.log_odds + frame.weight * gain)
            self._see(track, one, frame)
        hit, gone = {one.id for one in seen}, []
        for track in list(self.all.values()):
            if track.id in hit:
                continue
            if chance := view.chance(track):
                loss = math.log((1 - chance * s.hit_rate) / (1 - s.false_rate))
                track.log_odds += frame.weight * loss
                track.missed += frame.weight
            is_stale = not track.is_confirmed and frame.now - track.last > UNCONFIRMED
            if track.log_odds < math.log(s.false_rate) or is_stale:
                self.remove(track)
                gone += [track] if track.is_confirmed else []
        appeared = []
        for index, track in enumerate(seen):
            if not track.is_confirmed and track.exists >= s.confirm:
                seen[index] = self._confirm(track)
                appeared += [track] if seen[index] is track else []
        return Change(seen, appeared, gone)

    def _see(self, track: Track, seen: Seen, frame: Frame) -> None:
        before = track.place
        track.see(seen, frame.now, frame.weight)
        if track.place is None:
            return
        if before is None or _cell(before) != _cell(track.place):
            if before is not None:
                self._cells[_cell(before)].pop(track.id, None)
            self._cells[_cell(track.place)][track.id] = track
        track.room = self.room_of(track.place, frame.room)

    def _confirm(self, track: Track) -> Track:
        """Confirm a new track. Return it, or the older track of the same thing if it has moved.

        A thing that moved is the only one of its label that is not at its old place.
        """
        track.is_confirmed = True
        moved = [
            one
            for one in self.all.values()
            if one.is_confirmed and one.room == track.room and one.label == track.label
            and one.last < track.first and one.missed >= 2 and one.place is not None
        ]  # fmt: skip
        if len(moved) != 1 or track.place is None:
            return track
        old = moved[0]
        self.remove(track)
        self.remove(old)
        old.place, old.size, old.yaw = track.place, track.size, track.yaw
        old.looks, old.last, old.missed = track.looks, track.last, 0.0
        self.add(old)
        return old

    # ------------------------------------------------------------------------------ association

    def _associate(self, frame: Frame) -> list[Track]:
        """Return the track of each detection. New things get new tracks."""
        pairs = [
            (cost, index, track.id)
            for index, seen in enumerate(frame.seen)
            for cost, track in self._candidates(seen, frame)
        ]
        used: set[str] = set()
        of: dict[int, Track] = {}
        for _, index, name in sorted(pairs):
            if index not in of and name not in used:
                of[index] = self.all[name]
                used.add(name)
        return [of.get(index) or self._new(frame) for index in range(len(frame.seen))]

    def _candidates(self, seen: Seen, frame: Frame) -> Iterator[tuple[float, Track]]:
        """Yield the tracks that a detection may show, with costs.

        The cost is the distance in gates, plus 1 minus the share of the labels in the votes.
        """
        if seen.place is None:
            for rank, track in enumerate(self.all.values()):
                if track.place is None and track.room == frame.room:
                    if (like := track.likeness(seen)) >= 0.2:
                        yield 1 - like + rank * 1e-6, track
            return
        i, j = _cell(seen.place)
        for cell in [(a, b) for a in (i - 1, i, i + 1) for b in (j - 1, j, j + 1)]:
            for track in self._cells.get(cell, {}).values():
                distance = math.dist(seen.place, track.place or seen.place)
                gate = self._gate(track.size or seen.size)
                if distance > gate:
                    continue
                like = track.likeness(seen)
                is_swap = distance < self.settings.gate and _are_similar(seen.size, track.size)
                if like > 0 or is_swap:
                    yield distance / gate + 1 - like, track

    def _gate(self, size: Vector | None) -> float:
        return min(CELL, self.settings.gate + max(size or (0,)) / 4)

    def _new(self, frame: Frame) -> Track:
        self.count += 1
        prior = math.log(self.settings.prior / (1 - self.settings.prior))
        track = Track(f"t{self.count}", frame.room, prior, frame.now, frame.now)
        self.all[track.id] = track
        return track

    def follow_shift(self, seen: list[Seen]) -> None:
        """Follow a jump of the map, and subtract the shift of the map from the detections.

        The shift changes if most detections of a frame agree on another one.
        """
        placed = [one for one in seen if one.place is not None]
        self._find_shift(placed)
        for one in placed:
            one.place = minus(one.place or self.shift, self.shift)

    def _find_shift(self, placed: list[Seen]) -> None:
        by_label = defaultdict(list)
        labels = {label for one in placed for label in one.labels}
        for track in self.all.values():
            if track.is_confirmed and track.place is not None and (own := track.label) in labels:
                by_label[own].append(track.place)
        votes: Counter[tuple[int, int]] = Counter()
        offsets = defaultdict(list)
        width, here = self.settings.gate, 0
        for one in placed:
            own = minus(one.place or self.shift, self.shift)
            near = [
                minus(own, place)
                for place in by_label.get(max(one.labels, key=one.labels.__getitem__), ())
                if math.dist(own, place) < FARTHEST_SHIFT
            ]
            here += any(math.hypot(*by) < width for by in near)
            bins = {
                (math.floor(x / width) + a, math.floor(y / width) + b)
                for x, y, _ in near
                for a in (0, 1)
                for b in (0, 1)
            }
            votes.update(bins)
            for x, y, z in near:
                offsets[math.floor(x / width), math.floor(y / width)].append((x, y, z))
        if not votes:
            return
        # A bin is a square of two by two cells, so that an edge does not divide the votes.
        (i, j), count = max(votes.items(), key=lambda item: (item[1], -math.hypot(*item[0])))
        if count < 3 or 2 * count <= len(placed) or 2 * here > count:
            return
        near = [by for a in (i - 1, i) for b in (j - 1, j) for by in offsets.get((a, b), ())]
        middle = [sorted(axis)[len(near) // 2] for axis in zip(*near, strict=True)]
        self.shift = plus(self.shift, (middle[0], middle[1], middle[2]))


class LookedAt:
    """Which tracks a frame looks at.

    With a view, these are the tracks inside it. Without rooms, a wall may hide a track, so the
    frame must show something at least as far in about the same direction. Without a view, the frame
    must show things on both sides of the track, and one farther away. Without a position, the frame
    must be about the same room.
    """

    def __init__(self, frame: Frame) -> None:
        self._frame = frame
        self._seen = [self._polar(one.place) for one in frame.seen if one.place is not None]

    def chance(self, track: Track) -> float:
        """Return the probability that the frame shows a track that exists."""
        frame = self._frame
        if frame.is_walled and track.room != frame.room:
            return 0.0
        if track.place is None:
            return LABELS if track.room == frame.room else 0.0
        if frame.pose is None:
            return 0.0
        angle, distance = self._polar(track.place)
        if frame.view is not None:
            if 2 * abs(angle) > frame.view[0] or distance > frame.view[1]:
                return 0.0
            if frame.is_walled:
                return FULL
        beside = [
            (by, far)
            for other, far in self._seen
            if abs(by := math.remainder(other - angle, math.tau)) < _NEXT_TO
        ]
        if not any(far > distance for _, far in beside):
            return 0.0
        if frame.view is not None:
            return FULL
        return POSES if any(by > 0 for by, _ in beside) and any(by < 0 for by, _ in beside) else 0.0

    def _polar(self, place: Vector) -> Point:
        x, y, yaw = self._frame.pose or (0.0, 0.0, 0.0)
        dx, dy = place[0] - x, place[1] - y
        return math.remainder(math.atan2(dy, dx) - yaw, math.tau), math.hypot(dx, dy)


def inside(point: Point, polygon: Iterable[Point]) -> bool:
    """Return whether a polygon contains a point (even-odd rule)."""
    x, y = point
    corners = list(polygon)
    odd = False
    for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True):
        if (ay > y) != (by > y) and x < ax + (y - ay) * (bx - ax) / (by - ay):
            odd = not odd
    return odd


def to_edge(point: Point, polygon: Iterable[Point]) -> float:
    """Return the distance from a point to the nearest edge of a polygon in metres."""
    corners = list(polygon)
    return min(
        _to_segment(point, a, b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)
    )


def _to_segment(point: Point, a: Point, b: Point) -> float:
    dx, dy = b[0] - a[0], b[1] - a[1]
    along = ((point[0] - a[0]) * dx + (point[1] - a[1]) * dy) / (dx * dx + dy * dy or 1.0)
    along = max(0.0, min(1.0, along))
    return math.hypot(point[0] - a[0] - along * dx, point[1] - a[1] - along * dy)


def _cell(place: Vector) -> tuple[int, int]:
    return math.floor(place[0] / CELL), math.floor(place[1] / CELL)


def plus(a: Vector, b: Vector) -> Vector:
    """Return the sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def minus(a: Vector, b: Vector) -> Vector:
    """Return the difference of two vectors."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _mean(old: Vector | None, new: Vector | None, share: float) -> Vector | None:
    if old is None or new is None:
        return new or old
    x, y, z = (a + share * (b - a) for a, b in zip(old, new, strict=True))
    return x, y, z


def _are_similar(a: Vector | None, b: Vector | None) -> bool:
    if a is None or b is None:
        return True
    low, high = sorted((math.hypot(*a), math.hypot(*b)))
    return high <= SIMILAR * low


def _vector(value: schemas.Position | schemas.Size | None) -> Vector | None:
    return None if value is None else (value.x, value.y, value.z)


def _yaw(one: schemas.Detection) -> float | None:
    if (q := one.orientation) is None:
        return one.yaw
    return math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
