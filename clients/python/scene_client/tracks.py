"""Tracks of things: which detections show one thing, whether the thing exists, and its label.

Lengths are in metres in the frame ``map``, angles in radians, and times in seconds.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any, Final

from pydantic import Field

from scene_client import schemas
from scene_client.calls import validated
from scene_client.home_settings import Latch, Settings
from scene_client.schemas.requests import Angle, Coordinate, Extent, Label, Name

Vector = tuple[float, float, float]
Point = tuple[float, float]

# Types of values that a file may state.
Place = tuple[Coordinate, Coordinate, Coordinate]
Sides = tuple[Extent, Extent, Extent]
Votes = Annotated[dict[Label, Annotated[float, Field(gt=0)]], Field(min_length=1)]
LogOdds = Annotated[float, Field(ge=-100, le=100)]

CELL: Final = 1.0  # width of a cell of the grid of tracks, and the largest gate
MOST_CERTAIN: Final = 8.0  # largest log-odds of existence; a gone thing needs about 10 looks
MEMORY: Final = 20.0  # looks after which the mean of a position forgets older looks
UNCONFIRMED: Final = 60.0  # seconds without a detection after which an unconfirmed track ends
FARTHEST_JUMP: Final = 2.5  # of the map
SIMILAR: Final = 1.3  # largest ratio of the diagonals of two boxes of one thing with two labels
NOTABLE: Final = 0.2  # least share of the votes of a label that is no error of the detector
BESIDE: Final = math.radians(45)  # between a thing and its neighbours in a frame without a view
# Probability that a frame shows a thing: in a known view, between others, in the same room.
FULL, POSES, LABELS = 1.0, 0.6, 0.25


@dataclass
class Seen:
    """One detection: the confidence of each label, and its box."""

    labels: dict[str, float]
    place: Vector | None = None
    size: Vector | None = None
    yaw: float | None = None


def read_detections(detections: Iterable[Any]) -> list[Seen]:
    """Return the detections of a frame, or raise an `InvalidRequestError`.

    Detections whose position is not finite are left out: the camera had no depth there.
    """
    located = [one for one in detections if _is_located(one)]
    request = validated(schemas.SceneRequest, {"objects": located})
    return [Seen({one: 1.0}) if isinstance(one, str) else _seen(one) for one in request.objects]


def _is_located(detection: Any) -> bool:
    """Return whether the position of a detection has no NaN and no infinity."""
    at = detection.get("position") if isinstance(detection, Mapping) else None
    values = at.values() if isinstance(at, Mapping) else at if isinstance(at, list | tuple) else ()
    return all(math.isfinite(one) for one in values if isinstance(one, int | float))


def _seen(one: schemas.Detection) -> Seen:
    labels = {guess.label: guess.confidence for guess in one.alternatives}
    place = None if (at := one.position) is None else (at.x, at.y, at.z)
    size = None if (box := one.size) is None else (box.x, box.y, box.z)
    yaw = one.yaw
    if (q := one.orientation) is not None:
        yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
    return Seen(labels | {one.label: one.confidence}, place, size, yaw)


@dataclass
class Track:
    """One thing, or a wrong detection as long as it is not confirmed."""

    id: Name
    room: str
    log_odds: LogOdds  # ln(p / (1 - p)) of the probability that the thing exists
    first: float  # time of the first detection
    last: float  # time of the last detection
    votes: Votes = field(default_factory=dict)  # sum of confidences by label
    place: Place | None = None  # running mean, like the size
    size: Sides | None = None
    yaw: Angle | None = None
    looked: float | None = None  # time of the last look, with or without a detection
    judged: float | None = None  # time of the last step of the alarm
    named: str | None = None  # label in the last event about it
    looks: Annotated[float, Field(ge=0)] = 0.0  # number of looks with a detection
    missed: float = 0.0  # number of looks without one, since the last detection
    is_confirmed: bool = False
    verdict: str | None = None  # kind of alarm in the last answer
    probability: float = 0.0  # of this verdict
    alarm: Latch = field(default_factory=Latch)

    @property
    def label(self) -> str:
        """Label with the most votes."""
        return max(self.votes, key=self.votes.__getitem__)

    @property
    def exists(self) -> float:
        """Probability that the thing exists."""
        return 1 / (1 + math.exp(-self.log_odds))

    @property
    def confidence(self) -> float:
        """Probability that the thing exists and has its label."""
        return self.exists * self.labels[self.label]

    @property
    def labels(self) -> dict[str, float]:
        """Probabilities of the labels, if the thing exists. Rare votes count as errors."""
        # One swapped label in ten looks must not make the service doubt the other nine.
        label, shares = self.label, {one: self.share(one) for one in self.votes}
        notable = {k: share for k, share in shares.items() if share >= NOTABLE or k == label}
        return {one: share / sum(notable.values()) for one, share in notable.items()}

    def share(self, label: str) -> float:
        """Return the share of a label in the votes."""
        return self.votes.get(label, 0.0) / sum(self.votes.values())

    def likeness(self, seen: Seen) -> float:
        """Return the mean share of the labels of a detection, from 0 to 1."""
        shares = sum(vote * self.share(label) for label, vote in seen.labels.items())
        return shares / sum(seen.labels.values())

    def see(self, seen: Seen, now: float, weight: float) -> None:
        """Add the votes of a detection, and its box to the running means."""
        for label, vote in seen.labels.items():
            self.votes[label] = self.votes.get(label, 0.0) + weight * vote
        self.looks += weight
        share = weight / min(self.looks, MEMORY)
        self.place = _mean(self.place, seen.place, share)
        self.size = _mean(self.size, seen.size, share)
        self.yaw = self.yaw if seen.yaw is None else seen.yaw
        self.last, self.missed = now, 0.0

    def as_object(self, shift: Vector) -> dict[str, Any]:
        """Return the thing as an object of a request, in the frame of the map."""
        label = self.label
        thing: dict[str, Any] = {"id": self.id, "label": label}
        thing["confidence"] = max(0.01, round(self.confidence, 3))
        if others := [(share, one) for one, share in self.labels.items() if one != label]:
            share, second = max(others)
            share = max(0.01, round(self.exists * share, 3))
            thing["alternatives"] = [{"label": second, "confidence": share}]
        if self.place is not None:
            thing["position"] = [round(value, 3) for value in plus(self.place, shift)]
        if self.size is not None:
            thing["size"] = [round(value, 3) for value in self.size]
        return thing if self.yaw is None else thing | {"yaw": round(self.yaw, 4)}


@dataclass
class Frame:
    """One frame, and which tracks it looks at."""

    seen: list[Seen]
    now: float
    pose: Vector | None  # x, y and yaw of the robot
    view: Point | None  # full horizontal angle of the camera, and its reach
    room: str  # room of the robot

    def chance(self, track: Track) -> float:
        """Return the probability that the frame shows a track, if its thing exists.

        With a view, the track must be inside it. If no room bounds the view, the frame must also
        show something farther away beside the track, or a wall may hide it. Without a view, the
        frame must show things on both sides of the track, and one farther away. Without a position,
        the frame must be about the same room.
        """
        if track.room != self.room:
            return 0.0
        if track.place is None or self.pose is None:
            return LABELS if track.place is None else 0.0
        angle, distance = self._polar(track.place)
        if self.view is not None:
            if 2 * abs(angle) > self.view[0] or distance > self.view[1]:
                return 0.0
            if self.room:
                return FULL
        if not self._seen_at or distance > self._seen_at[0][1]:
            return 0.0
        beside = [(math.remainder(one - angle, math.tau), far) for one, far in self._seen_at]
        beside = [(by, far) for by, far in beside if abs(by) < BESIDE]
        if all(far < distance for _, far in beside):
            return 0.0
        is_between = min(beside)[0] < 0 < max(beside)[0]
        return FULL if self.view is not None else POSES if is_between else 0.0

    @cached_property
    def _seen_at(self) -> list[Point]:
        found = [self._polar(one.place) for one in self.seen if one.place is not None]
        return sorted(found, key=lambda one: -one[1])  # farthest first

    def _polar(self, place: Vector) -> Point:
        x, y, yaw = self.pose or (0.0, 0.0, 0.0)
        dx, dy = place[0] - x, place[1] - y
        return math.remainder(math.atan2(dy, dx) - yaw, math.tau), math.hypot(dx, dy)


class Tracks:
    """All tracks of a home. `room_of` returns the room of a place, given its room before."""

    def __init__(self, settings: Settings, room_of: Callable[[Vector, str], str]) -> None:
        self.settings, self.room_of = settings, room_of
        self.all: dict[str, Track] = {}
        self.shift: Vector = (0.0, 0.0, 0.0)  # of the map since the start, in the plane
        self.count = 0
        self._cells: dict[tuple[int, int], dict[str, Track]] = defaultdict(dict)

    def add(self, track: Track) -> None:
        """Add a track."""
        self.all[track.id] = track
        if track.place is not None:
            self._cells[_cell(track.place)][track.id] = track

    def remove(self, track: Track) -> None:
        """Remove a track."""
        del self.all[track.id]
        if track.place is not None:
            del self._cells[_cell(track.place)][track.id]

    def update(self, frame: Frame) -> tuple[list[Track], list[Track], list[Track]]:
        """Return the track of each detection, the new things, and the gone things.

        Existence is a log-odds filter. With the probability v that the frame shows the thing, the
        hit rate h and the false rate f, a hit of confidence c adds c ln(v h / f), and a miss adds
        ln((1 - v h) / (1 - f)), each times the number of looks since the last one, at most 1.
        """
        s, seen = self.settings, self._associate(frame)
        for track, one in zip(seen, frame.seen, strict=True):
            chance = LABELS if one.place is None else FULL
            hit = min(1.0, sum(one.labels.values())) * math.log(chance * s.hit_rate / s.false_rate)
            weight = _new_looks(track.last if track.looks else None, frame.now, s.look)
            track.looked = frame.now
            track.log_odds = min(MOST_CERTAIN, track.log_odds + weight * hit)
            if track.place is not None:
                del self._cells[_cell(track.place)][track.id]
            track.see(one, frame.now, weight)
            if track.place is not None:
                self._cells[_cell(track.place)][track.id] = track
                track.room = self.room_of(track.place, track.room)
        hits, gone, appeared = {one.id for one in seen}, [], []
        for track in [one for one in self.all.values() if one.id not in hits]:
            if chance := frame.chance(track):
                miss = math.log((1 - chance * s.hit_rate) / (1 - s.false_rate))
                weight = _new_looks(track.looked, frame.now, s.look)
                track.looked = frame.now
                track.log_odds += weight * miss
                track.missed += weight
            is_stale = not track.is_confirmed and frame.now - track.last > UNCONFIRMED
            if track.log_odds < math.log(s.false_rate) or is_stale:
                self.remove(track)
                gone += [track] if track.is_confirmed else []
        for index, track in enumerate(seen):
            if not track.is_confirmed and track.exists >= s.confirm:
                seen[index] = self._confirm(track)
                appeared += [track] if seen[index] is track else []
        return seen, appeared, gone

    def _confirm(self, track: Track) -> Track:
        """Confirm a new track. Return it, or the only absent one of its label, which has moved."""
        track.is_confirmed = True
        absent = [
            one
            for one in self.all.values()
            if one.is_confirmed and one.room == track.room and one.label == track.label
            and one.last < track.first and one.missed >= 2 and one.place is not None
        ]  # fmt: skip
        if len(absent) != 1 or track.place is None:
            return track
        for one in (track, old := absent[0]):
            self.remove(one)
        old.place, old.size, old.yaw = track.place, track.size, track.yaw
        old.looks, old.last, old.missed = track.looks, track.last, 0.0
        self.add(old)
        return old

    def _associate(self, frame: Frame) -> list[Track]:
        """Return the track of each detection, nearest first. New things get new tracks."""
        pairs = [
            (cost, index, track.id)
            for index, seen in enumerate(frame.seen)
            for cost, track in self._candidates(seen, frame.room)
        ]
        track_of, used = dict[int, Track](), set[str]()
        for _, index, name in sorted(pairs):
            if index not in track_of and name not in used:
                track_of[index] = self.all[name]
                used.add(name)
        return [track_of.get(index) or self._new(frame) for index in range(len(frame.seen))]

    def _candidates(self, seen: Seen, room: str) -> Iterator[tuple[float, Track]]:
        """Yield costs and tracks that a detection may show. Without positions, older ones first.

        The cost is the distance in gates, plus 1 minus the share of the labels in the votes.
        """
        if seen.place is None:
            for rank, track in enumerate(self.all.values()):
                is_here = track.place is None and track.room == room
                if is_here and (like := track.likeness(seen)) >= NOTABLE:
                    yield 1 - like + rank * 1e-6, track
            return
        i, j = _cell(seen.place)
        for cell in [(a, b) for a in (i - 1, i, i + 1) for b in (j - 1, j, j + 1)]:
            for track in self._cells.get(cell, {}).values():
                distance = math.dist(seen.place, track.place or seen.place)
                side = max(track.size or seen.size or (0.0,))
                gate = min(CELL, self.settings.gate + side / 4)
                like = track.likeness(seen) if distance < gate else -1.0
                is_near = distance < self.settings.gate and _are_similar(seen.size, track.size)
                if like > 0 or (like == 0 and is_near):
                    yield distance / gate + 1 - like, track

    def _new(self, frame: Frame) -> Track:
        self.count += 1
        prior = math.log(self.settings.prior / (1 - self.settings.prior))
        track = Track(f"t{self.count}", frame.room, prior, frame.now, frame.now)
        self.add(track)
        return track

    def follow_jump(self, seen: Iterable[Seen]) -> None:
        """Subtract the shift of the map from the detections. Follow a jump of the map.

        The map has jumped if most detections agree on one offset from tracks of the same label, at
        least three and twice as many as with the old shift.
        """
        placed = [one for one in seen if one.place is not None]
        tracks = defaultdict(list)
        for track in self.all.values():
            if track.is_confirmed and track.place is not None:
                tracks[track.label].append(track.place)
        offsets = []
        for one in placed:
            one.place = minus(one.place or self.shift, self.shift)
            by_label = tracks.get(max(one.labels, key=one.labels.__getitem__), ())
            near = sorted((math.dist(one.place, at), at) for at in by_label)[:8]
            offsets.append([minus(one.place, at) for far, at in near if far < FARTHEST_JUMP])

        def alike(by: Vector) -> list[Vector]:
            near = (min(some, key=lambda one: math.dist(one, by)) for some in offsets if some)
            return [one for one in near if math.dist(one, by) < self.settings.gate]

        unmoved = len(alike((0.0, 0.0, 0.0)))
        if 2 * unmoved >= len(placed):
            return
        found = max((alike(by) for some in offsets for by in some), key=len, default=[])
        if len(found) < max(3, 2 * unmoved) or 2 * len(found) <= len(placed):
            return
        x, y, _ = (sum(axis) / len(found) for axis in zip(*found, strict=True))
        self.shift, jump = plus(self.shift, (x, y, 0.0)), (x, y, 0.0)
        for one in placed:
            one.place = minus(one.place or jump, jump)


def plus(a: Vector, b: Vector) -> Vector:
    """Return the sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def minus(a: Vector, b: Vector) -> Vector:
    """Return the difference of two vectors."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _new_looks(last: float | None, now: float, look: float) -> float:
    """Return the number of independent looks since the last one, at most 1."""
    return 1.0 if last is None or now < last else min(1.0, (now - last) / look)


def _cell(place: Vector) -> tuple[int, int]:
    return math.floor(place[0] / CELL), math.floor(place[1] / CELL)


def _mean(old: Vector | None, new: Vector | None, share: float) -> Vector | None:
    if old is None or new is None:
        return new or old
    x, y, z = minus(new, old)
    return plus(old, (share * x, share * y, share * z))


def _are_similar(a: Vector | None, b: Vector | None) -> bool:
    low, high = sorted((math.hypot(*(a or b or ())), math.hypot(*(b or a or ()))))
    return high <= SIMILAR * low
