"""A home: what a moving robot knows about its rooms, between a detector and the questions.

docs/moving.md describes the class `Home`.
"""

from __future__ import annotations

import atexit
import json
import logging
import math
import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from typing_extensions import Self

from scene_client import schemas
from scene_client.errors import ClientError, HomeFileError, InvalidRequestError
from scene_client.recorder import Recorder
from scene_client.tracks import (
    Frame,
    Latch,
    Point,
    Settings,
    Track,
    Tracks,
    Vector,
    inside,
    plus,
    read_detections,
    to_edge,
)

if TYPE_CHECKING:
    from scene_client.sync import Client

VERSION: Final = 1
"""Version of the file of a home."""
EDGE: Final = 0.2
"""A thing at most this distance in metres outside of the robot's room counts as inside."""
NEAR: Final = 5.0
"""Without rooms, the things within this distance of the robot in metres are its room."""
LOST_TIMEOUT: Final = 0.3
"""Maximum time of a try in seconds while the service is lost."""
FIRST_PAUSE, LONGEST_PAUSE = 2.0, 30.0
"""Seconds between two tries while the service is lost. The pause doubles with each try."""
NOTABLE: Final = 0.2
"""Share of the votes from which the second label is an alternative."""
MOST_OBJECTS: Final = 256
UNKNOWN: Final = "nearest-or-ignore"
MARGIN: Final = 0.1
"""Difference of probabilities from which another type of a room is likelier."""
LIKELY: Final = 0.2
"""Probability of existence from which a thing is evidence for the type of its room."""
LOOKS: Final = 8
"""Number of headings after which the robot has looked around in a room."""
LABEL_LOOKS: Final = 30
"""Number of looks without poses after which the robot has seen a room."""

Kind = Literal[
    "appeared", "gone", "out-of-place", "misplaced", "misdetection", "cleared", "room", "service"
]

_logger: Final = logging.getLogger(__name__)


@dataclass(frozen=True)
class Event:
    """One change of a home.

    Attributes:
        kind: `appeared` and `gone`: a thing. `out-of-place`, `misplaced` and `misdetection`: an
            alarm about a thing, raised or of a new kind. `cleared`: its alarm is over. `room`: the
            type of a room is settled or changes. `service`: lost or back.
        stamp: time of the change.
        since: start of the state that the event reports.
        id: track of the thing.
        label: label of the thing, type of the room, or `lost` or `back`.
        room: name of the room.
        probability: probability in the last answer.
        detail: the former alarm, the former type, or the error of the service.
    """

    kind: Kind
    stamp: float
    since: float
    id: str | None = None
    label: str | None = None
    room: str | None = None
    probability: float | None = None
    detail: str | None = None


@dataclass
class RoomState:
    """What a home knows about one room.

    Attributes:
        type: type of the room, once it is settled.
        best: likeliest type in the last answer of `/rooms`.
        probability: probability of this type.
        is_named: whether the name is a room type of the model. None if unknown.
        headings: directions of the looks, in eighths of a turn.
        looks: number of looks without a pose.
    """

    type: Latch = field(default_factory=Latch)
    best: str | None = None
    probability: float = 0.0
    is_named: bool | None = None
    headings: list[int] = field(default_factory=list)
    looks: float = 0.0


class Home:
    """State between a detector and the questions about the rooms of a home.

    Use a home in one thread. It saves itself to its file, also at the end of the program.

    Args:
        client: client of the service.
        rooms: polygon of each room in the frame ``map``, by name. Without polygons, the argument
            ``room`` of `update` names the room.
        path: file of the home. If it exists, the home resumes from it.
        view: full horizontal angle of the camera in radians, and its reach in metres.
        room_candidates: possible room types of the rooms whose name is no room type.
        record: file ``*.jsonl`` for confirmed scenes, as ``training adapt`` reads them.
        settings: the settings.

    Raises:
        HomeFileError: the file is damaged, or of a newer version.
    """

    def __init__(
        self,
        client: Client,
        rooms: Mapping[str, Sequence[Point]] | None = None,
        *,
        path: str | os.PathLike[str] | None = None,
        view: tuple[float, float] | None = None,
        room_candidates: Iterable[str] | None = None,
        record: str | os.PathLike[str] | None = None,
        settings: Settings | None = None,
    ) -> None:
        self.client = client
        self.settings = settings or Settings()
        self.path = None if path is None else Path(path)
        self.view = view
        self.room: str | None = None
        self.matched: list[str] = []
        self.confirmed: set[tuple[str, str | None]] = set()
        self._polygons = dict(rooms or {})
        self._candidates = list(room_candidates or ())
        self._recorder = None if record is None else Recorder(record)
        self._rooms: dict[str | None, RoomState] = {name: RoomState() for name in self._polygons}
        self._tracks = Tracks(self.settings, self._room_of)
        self._pose: Vector | None = None
        self._now = self._saved = -math.inf
        self._asked: dict[str | None, dict[str, Any]] = {}
        self._next = -math.inf
        self._lost: float | None = None  # pause until the next try
        if self.path is not None:
            self._load(self.path)
            atexit.register(self.close)

    # --------------------------------------------------------------------------------- a frame

    def update(
        self,
        detections: Iterable[str | schemas.Detection | schemas.Body],
        pose: Sequence[float] | Mapping[str, float] | None = None,
        stamp: float | schemas.Stamp | schemas.Body | None = None,
        *,
        room: str | None = None,
        view: tuple[float, float] | None = None,
    ) -> list[Event]:
        """Take the detections of one frame, also an empty one. Return what has changed.

        Args:
            detections: labels or detections, with positions in the frame ``map``.
            pose: x, y and yaw of the robot in this frame.
            stamp: time of the frame in seconds. Default: the clock of the computer.
            room: name of the room that the frame shows. Default: the polygon with the robot.
            view: the view of this frame, instead of that of the home.

        Raises:
            InvalidRequestError: a detection is invalid.
        """
        seen = read_detections(detections)
        now, before = _seconds(stamp), self._now
        elapsed = now - before
        if elapsed < 0:  # a recording starts again
            self._next = self._saved = -math.inf
        self._now, elapsed = now, max(0.0, elapsed)
        self._tracks.follow_shift(seen)
        self._pose = at = self._own_pose(pose)
        self.room = room if room is not None else self._robot_room(at)
        weight = min(1.0, elapsed / self.settings.look)
        frame = Frame(seen, now, weight, at, view or self.view, self.room, self.room is not None)
        change = self._tracks.update(frame)
        self.matched = [one.id for one in change.seen]
        self._count_look(at, weight)
        events = [self._event("appeared", one, since=one.first) for one in change.appeared]
        events += [self._event("gone", one, since=one.last) for one in change.gone]
        events += self._ask()
        if self._lost is None:
            events += self._alarms(change.seen, elapsed)
            events += self._settle(elapsed)
        if self.path is not None and now - self._saved >= self.settings.save_every:
            self._try_save()
        return events

    def _own_pose(self, pose: Sequence[float] | Mapping[str, float] | None) -> Vector | None:
        if pose is None:
            return None
        x, y, yaw = (pose[n] for n in ("x", "y", "yaw")) if isinstance(pose, Mapping) else pose
        shift = self._tracks.shift
        return x - shift[0], y - shift[1], yaw

    def _robot_room(self, pose: Vector | None) -> str | None:
        if pose is None or not self._polygons:
            return None
        return self._room_of(pose, None) or self.room

    def _room_of(self, place: Vector, robot_room: str | None) -> str | None:
        """Return the room of a thing. Things at the edge belong to the room of the robot."""
        if not self._polygons:
            return robot_room
        point = place[:2]
        polygon = self._polygons.get(robot_room or "")
        if polygon is not None and to_edge(point, polygon) <= EDGE:
            return robot_room
        found = (name for name, corners in self._polygons.items() if inside(point, corners))
        return next(found, None)

    def _count_look(self, pose: Vector | None, weight: float) -> None:
        state = self._rooms.setdefault(self.room, RoomState())
        if pose is None:
            state.looks += weight
        elif (heading := math.floor(pose[2] / math.tau * LOOKS) % LOOKS) not in state.headings:
            state.headings.append(heading)

    def _alarms(self, hit: Iterable[Track], elapsed: float) -> Iterator[Event]:
        """Count the verdicts about the seen things. Other alarms stay as they are."""
        s = self.settings
        step = min(min(1.0, elapsed) / s.hold, max(elapsed / s.look, 0) / s.answers, 1 / s.answers)
        for track in hit:
            verdict = None if self._is_habit(track) else track.verdict
            former = track.alarm.value
            if track.is_confirmed and track.alarm.update(verdict, self._now, step):
                kind: Any = verdict or "cleared"
                yield self._event(kind, track, since=track.alarm.since, detail=former)

    def _event(self, kind: Kind, track: Track, *, since: float, detail: str | None = None) -> Event:
        return Event(
            kind, self._now, since, track.id, track.label, track.room, track.probability, detail
        )

    def _is_habit(self, track: Track) -> bool:
        return (track.label, track.room) in self.confirmed

    # ------------------------------------------------------------------------------- questions

    def _ask(self) -> Iterator[Event]:
        """Ask about the room of the robot if its things have changed, or its type is open."""
        if self._now < self._next:
            return
        things, state = self._things(self.room), self._rooms[self.room]
        is_new = self._lost is not None or self._has_changed(things)
        is_open = state.is_named is not True and (is_new or state.type.value is None)
        timeout = self.settings.timeout if self._lost is None else LOST_TIMEOUT
        try:
            if is_open and (likely := self._things(self.room, LIKELY)):
                self._ask_type(likely, state, timeout)
            if is_new and things:
                self._ask_outliers(things, state, timeout)
        except InvalidRequestError:
            raise
        except ClientError as error:
            if self._lost is None:
                yield Event("service", self._now, self._now, label="lost", detail=str(error))
            pause = FIRST_PAUSE if self._lost is None else min(LONGEST_PAUSE, 2 * self._lost)
            self._lost, self._next = pause, self._now + pause
            return
        if self._lost is not None and things:
            yield Event("service", self._now, self._now, label="back")
            self._lost = None
        self._next = self._now + self.settings.pause

    def _has_changed(self, things: list[Track]) -> bool:
        step, asked = self.settings.step, self._asked.get(self.room, {})
        if asked.keys() != {one.id for one in things}:
            return True
        for one in things:
            label, confidence, place = asked[one.id]
            if label != one.label or abs(confidence - _confidence(one)) > step:
                return True
            if place is not None and math.dist(place, one.place or place) > step:
                return True
        return False

    def _ask_type(self, things: list[Track], state: RoomState, timeout: float) -> None:
        scene = self._scene(things, None)
        options = {"candidates": self._candidates} if self._candidates else {}
        answer = self.client.rooms(
            scene["objects"], unknown_labels=UNKNOWN, detail="scores", timeout=timeout, **options
        )
        types = {one.room_type: one.probability for one in answer.room_types}
        if types:
            best = max(types, key=types.__getitem__)
            if types[best] - types.get(state.best or "", 0.0) > MARGIN:
                state.best = best
            state.probability = types.get(state.best or "", 0.0)

    def _ask_outliers(self, things: list[Track], state: RoomState, timeout: float) -> None:
        scene = self._scene(things, self.room)
        answer = self.client.outliers(
            **scene, sensitivity=self.settings.sensitivity, timeout=timeout
        )
        if "room_type" in scene and state.is_named is None:
            guessed = [one.label for one in answer.mapped if one.similarity < 1]
            state.is_named = self.room not in (*answer.ignored, *guessed)
        self._asked[self.room] = {one.id: (one.label, _confidence(one), one.place) for one in things}
        misplaced = {
            one.moved or one.subject: one.probability for one in answer.misplaced if one.is_misplaced
        }
        for outlier in answer.outliers:
            if (track := self._tracks.all.get(outlier.object)) is None:
                continue
            track.probability, track.verdict = outlier.probability, None
            if outlier.is_outlier:
                track.verdict = "out-of-place"
            elif outlier.object in misplaced:
                track.verdict = "misplaced"
                track.probability = misplaced[outlier.object]
            elif outlier.reason == "misdetection":
                track.verdict, track.probability = "misdetection", 1 - outlier.real

    def _settle(self, elapsed: float) -> Iterator[Event]:
        """Count the answer about the type of the robot's room. Doubtful answers count less."""
        state, s = self._rooms[self.room], self.settings
        sure = state.probability
        step = sure * min(min(1.0, elapsed) / s.room_hold, 1 / s.answers)
        former = state.type.value
        if state.best and state.type.update(state.best, self._now, step):
            yield Event(
                "room", self._now, state.type.since, label=state.best, room=self.room,
                probability=state.probability, detail=former,
            )  # fmt: skip

    def room_type(self, room: str | None = None) -> str | None:
        """Return the type of a room, by default of the robot's room. None means unknown.

        Before the type is settled, it is the likeliest one of the last answer.
        """
        room = self.room if room is None else room
        state = self._rooms.get(room, RoomState())
        return room if state.is_named else state.type.value or state.best

    @property
    def alarms(self) -> list[Event]:
        """The alarms that are on."""
        return [
            self._event(one.alarm.value, one, since=one.alarm.since)  # type: ignore[arg-type]
            for one in self._tracks.all.values()
            if one.alarm.value is not None
        ]

    def things(self, room: str | None = None) -> list[Track]:
        """Return the present things of a room, or of all rooms."""
        present = [one for one in self._tracks.all.values() if one.is_confirmed]
        return present if room is None else [one for one in present if one.room == room]

    def scene(self, room: str | None = None) -> dict[str, Any]:
        """Return a request about a room, by default about the robot's room, without the question.

        ``client.outliers(**home.scene("kitchen"))`` asks about a room.
        """
        room = self.room if room is None else room
        return self._scene(self._things(room), room)

    def _things(self, room: str | None, exists: float | None = None) -> list[Track]:
        """Return the most certain things of a room, by default the present ones.

        Without rooms, these are the things near the robot.
        """
        found = [
            one
            for one in self._tracks.all.values()
            if one.room == room
            and (one.is_confirmed if exists is None else one.exists >= exists)
            and (room is not None or one.place is None or self._pose is None
                 or math.dist(one.place[:2], self._pose[:2]) <= NEAR)
        ]  # fmt: skip
        return sorted(found, key=_confidence, reverse=True)[:MOST_OBJECTS]

    def _scene(self, things: Iterable[Track], room: str | None) -> dict[str, Any]:
        shift = self._tracks.shift
        scene: dict[str, Any] = {
            "objects": [_object(one, shift) for one in things],
            "unknown_labels": UNKNOWN,
        }
        if any("position" in one for one in scene["objects"]):
            scene["frame_id"] = "map"
            if self._pose is not None:
                x, y, yaw = plus(self._pose, (*shift[:2], 0.0))
                scene["viewpoint"] = {"x": x, "y": y, "yaw": yaw}
        if room is not None and self._rooms.get(room, RoomState()).is_named is not False:
            scene["room_type"] = room
        return scene

    def missing(self, room: str | None = None, **options: Any) -> schemas.MissingAnswer:
        """Ask which things a room lacks. `options` are those of `Client.missing`."""
        room = self.room if room is None else room
        return self.client.missing(
            **{**self.scene(room), "coverage": self.coverage(room), **options}
        )

    def coverage(self, room: str | None = None) -> float:
        """Return the share of a room that the robot has seen, from .2 at first sight to .9."""
        state = self._rooms.get(self.room if room is None else room, RoomState())
        share = max(len(state.headings) / LOOKS, state.looks / LABEL_LOOKS)
        return 0.2 + 0.7 * min(1.0, share)

    def where(
        self, label: str, searched: Iterable[schemas.Searched | schemas.Body] = (), **options: Any
    ) -> schemas.WhereAnswer:
        """Ask where a thing of the home is, or is likely. `options` are those of `Client.where`."""
        rooms, common = [], {}
        for name, state in self._rooms.items():
            scene = self.scene(name)
            room = {"id": name or "here", "objects": scene.pop("objects")}
            if (kind := scene.pop("room_type", None) or state.type.value) is not None:
                room["room_type"] = kind
            rooms.append(room | {"coverage": self.coverage(name)})
            common |= scene
        return self.client.where(label, rooms, **{**common, "searched": list(searched), **options})

    def confirm(self, id: str) -> list[Event]:
        """State that a thing belongs where it is. Return the alarms that this clears.

        Things of this label in this room raise no alarm from now on. With ``record``, the scene of
        the room is recorded as confirmed, without the things of other alarms.

        Raises:
            KeyError: the home has no such thing.
        """
        track = self._tracks.all[id]
        self.confirmed.add((track.label, track.room))
        events = []
        for one in self.things():
            if self._is_habit(one) and one.alarm.value is not None:
                former, one.alarm = one.alarm.value, Latch()
                events.append(self._event("cleared", one, since=self._now, detail=former))
        if self._recorder is not None:
            quiet = [one for one in self._things(track.room) if one.alarm.value is None]
            scene = self._scene(quiet, track.room) | {"confirmed": True}
            self._recorder.confirm(schemas.SceneRequest.model_validate(scene))
        return events

    # -------------------------------------------------------------------------------- the file

    def save(self, path: str | os.PathLike[str] | None = None) -> None:
        """Write the home to a file, by default to its own. A reader never sees a part of a file.

        Raises:
            OSError: the file cannot be written.
        """
        target = Path(path or self.path or "")
        state = {
            "format": "scene-home",
            "version": VERSION,
            "stamp": self._now if math.isfinite(self._now) else None,
            "room": self.room,
            "shift": self._tracks.shift,
            "count": self._tracks.count,
            "habits": sorted(self.confirmed, key=str),
            "rooms": [[name, asdict(one)] for name, one in self._rooms.items()],
            "tracks": [asdict(one) for one in self._tracks.all.values()],
        }
        sibling = target.with_name(f".{target.name}.{os.getpid()}")
        try:
            with sibling.open("w", encoding="utf-8") as file:
                json.dump(state, file, ensure_ascii=False, separators=(",", ":"))
                file.flush()
                os.fsync(file.fileno())
            sibling.replace(target)
        finally:
            sibling.unlink(missing_ok=True)

    def _load(self, path: Path) -> None:
        try:
            state = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return
        except (OSError, ValueError) as error:
            raise HomeFileError(f"{path} is not a readable file of a home: {error}") from None
        try:
            if state["format"] != "scene-home":
                raise ValueError("another format")
            if state["version"] > VERSION:
                raise HomeFileError(
                    f"{path} has version {state['version']}, but this client reads up to version "
                    f"{VERSION}. Install a newer client, or name another file."
                )
            self._restore(state)
        except (AttributeError, LookupError, TypeError, ValueError) as error:
            raise HomeFileError(
                f"{path} is not a whole file of a home ({error!r}). Restore it, or name another "
                "file. It is left as it is."
            ) from None

    def _restore(self, state: dict[str, Any]) -> None:
        if (stamp := state["stamp"]) is not None:
            self._now = self._saved = float(stamp)
        self.room, self._tracks.count = state["room"], int(state["count"])
        x, y, z = map(float, state["shift"])
        self._tracks.shift = x, y, z
        self.confirmed = {(str(label), room) for label, room in state["habits"]}
        for name, one in state["rooms"]:
            self._rooms[name] = RoomState(**one | {"type": Latch(**one["type"])})
        for one in state["tracks"]:
            for name in ("place", "size"):
                one[name] = None if one[name] is None else tuple(map(float, one[name]))
            self._tracks.add(Track(**one | {"alarm": Latch(**one["alarm"])}))

    def _try_save(self) -> None:
        self._saved = self._now
        try:
            self.save()
        except OSError as error:
            _logger.warning("cannot save the home in %s: %s", self.path, error)

    def close(self) -> None:
        """Save the home to its file, if it has one."""
        if self.path is not None:
            atexit.unregister(self.close)
            self._try_save()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _confidence(track: Track) -> float:
    """Return the probability that the thing exists and has its label."""
    return track.exists * track.share(track.label)


def _object(track: Track, shift: Vector) -> dict[str, Any]:
    """Return a track as an object of a request, in the frame of the map."""
    label, sure = track.label, track.exists
    thing: dict[str, Any] = {
        "id": track.id,
        "label": label,
        "confidence": max(0.01, round(_confidence(track), 3)),
    }
    others = [(track.share(one), one) for one in track.votes if one != label]
    if others and (second := max(others))[0] >= NOTABLE:
        thing["alternatives"] = [{"label": second[1], "confidence": round(sure * second[0], 3)}]
    if track.place is not None:
        thing["position"] = [round(value, 3) for value in plus(track.place, shift)]
    if track.size is not None:
        thing["size"] = [round(value, 3) for value in track.size]
    if track.yaw is not None:
        thing["yaw"] = round(track.yaw, 4)
    return thing


def _seconds(stamp: float | schemas.Stamp | schemas.Body | None) -> float:
    if stamp is None:
        return time.time()
    if isinstance(stamp, int | float):
        return float(stamp)
    if isinstance(stamp, Mapping):
        return float(stamp["sec"] + stamp["nanosec"] * 1e-9)
    return stamp.sec + stamp.nanosec * 1e-9
