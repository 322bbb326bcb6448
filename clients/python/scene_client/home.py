"""What a moving robot knows about a home, between a detector and questions (docs/moving.md)."""

from __future__ import annotations

import atexit
import logging
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, cast

from scene_client import schemas
from scene_client.errors import ClientError, InvalidRequestError, ProblemError, UnknownThingError
from scene_client.floor_plan import FloorPlan, pose_of
from scene_client.home_settings import Latch, Settings
from scene_client.home_state import (
    MOST_THINGS,
    UNKNOWN,
    Asked,
    Event,
    Kind,
    Room,
    State,
    read_state,
    seconds_of,
    write_state,
)
from scene_client.recorder import Recorder
from scene_client.tracks import Frame, Point, Track, Tracks, Vector, minus, plus, read_detections

if TYPE_CHECKING:
    from scene_client.sync import Client

NEAR: Final = 5.0  # metres around the robot; without rooms, the things within are its room
LIKELY: Final = 0.2  # probability of existence from which a thing is evidence for the room type
MARGIN: Final = 0.1  # difference from which another room type, or another label, is likelier
LOST_TIMEOUT: Final = 0.3  # seconds of a try while the service is lost
FIRST_PAUSE, LONGEST_PAUSE = 2.0, 30.0  # seconds between tries; the pause doubles each time

_logger: Final = logging.getLogger(__name__)


class Home(AbstractContextManager["Home"]):
    """State between a detector and the questions about the rooms of a home, for one thread.

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
        InvalidRequestError: a polygon has fewer than three corners.
    """

    def __init__(
        self,
        client: Client,
        rooms: Mapping[str, Sequence[Point]] | None = None,
        *,
        path: str | os.PathLike[str] | None = None,
        view: Point | None = None,
        room_candidates: Iterable[str] = (),
        record: str | os.PathLike[str] | None = None,
        settings: Settings | None = None,
    ) -> None:
        self.client, self.view, self.settings = client, view, settings or Settings()
        self.path = None if path is None else Path(path)
        self.room = ""  # of the robot
        self.matched: list[str] = []  # track of each detection of the last frame
        self.confirmed: set[tuple[str, str]] = set()  # habits: label and room
        self._plan, self._candidates = FloorPlan(rooms or {}), list(room_candidates)
        self._recorder = None if record is None else Recorder(record)
        self._rooms = {name: Room() for name in self._plan.rooms}
        self._tracks = Tracks(self.settings, self._room_of)
        self._pose: Vector | None = None
        self._now = self._saved = self._next = -math.inf
        self._asked = Asked(self.settings.step)
        self._lost: float | None = None  # seconds until the next try
        if self.path is not None:
            self._resume(read_state(self.path))
            atexit.register(self.close)

    # ---------------------------------------------------------------------------------- a frame

    def update(
        self,
        detections: Iterable[str | schemas.Detection | schemas.Body],
        pose: Sequence[float] | Mapping[str, float] | None = None,
        stamp: float | schemas.Stamp | schemas.Body | None = None,
        *,
        room: str | None = None,
        view: Point | None = None,
    ) -> list[Event]:
        """Take the detections of one frame, also of an empty one. Return what has changed.

        Positions and the `pose` (x, y, yaw) are in the frame ``map``. `stamp` is in seconds; the
        default is the clock of the computer. `room` is the robot's room; the default is the polygon
        with the robot. `view` replaces that of the home.

        Raises:
            InvalidRequestError: a detection or the pose is invalid.
        """
        seen, at = read_detections(detections), pose_of(pose)
        if (now := seconds_of(stamp)) < self._now:  # a recording starts again
            self._saved = self._next = now
            self._now = now - 1.0
        elapsed, self._now = now - self._now, now
        self._tracks.follow_jump(seen)
        self._pose = None if at is None else minus(at, self._tracks.shift)
        if room is None and self._pose is not None and self._plan.rooms:
            room = self._room_of(self._pose, self.room) or self.room
        self.room = room or ""
        weight = min(1.0, elapsed / self.settings.look)
        self._rooms.setdefault(self.room, Room()).look(self._pose, weight)
        frame = Frame(seen, now, self._pose, view or self.view, self.room)
        tracks, appeared, gone = self._tracks.update(frame)
        self.matched = [one.id for one in tracks]
        events = [self._event("appeared", one, one.first) for one in appeared]
        events += [self._event("gone", one, one.last) for one in gone]
        events += [*self._relabelled(tracks), *self._ask()]
        if self._lost is None:
            events += [*self._alarms(tracks), *self._settle(elapsed)]
        if self.path is not None and now - self._saved >= self.settings.save_every:
            self._try_save()
        return events

    def _room_of(self, place: Vector, room: str) -> str:
        return self._plan.room_of(place, room) if self._plan.rooms else self.room

    def _relabelled(self, seen: Iterable[Track]) -> Iterator[Event]:
        """Report the things whose votes are clearly for another label than in the last event."""
        for track in (one for one in seen if one.is_confirmed):
            former = track.named or track.label
            if track.share(track.label) - track.share(former) > MARGIN:
                yield self._event("relabelled", track, self._now, former)
                former = track.label
            track.named = former

    def _alarms(self, seen: Iterable[Track]) -> Iterator[Event]:
        """Count the verdicts about the seen things. Alarms of unseen things stay as they are."""
        for track in seen:
            last, track.judged = track.judged, self._now
            elapsed = 1.0 if last is None or last > self._now else self._now - last
            step = self._step(elapsed, self.settings.hold)
            verdict, former = None if self._is_habit(track) else track.verdict, track.alarm.value
            if track.is_confirmed and track.alarm.update(verdict, self._now, step):
                kind = cast(Kind, verdict or "cleared")
                yield self._event(kind, track, track.alarm.since, former)

    def _settle(self, elapsed: float) -> Iterator[Event]:
        """Count the answer about the type of the robot's room, in proportion to its probability."""
        room = self._rooms[self.room]
        former, step = room.type.value, self._step(elapsed, self.settings.room_hold)
        best = None if room.is_named else room.best
        if best and room.type.update(best, self._now, room.probability * step):
            yield Event(
                "room", self._now, room.type.since, label=best, room=self.room,
                probability=room.probability, detail=former,
            )  # fmt: skip

    def _step(self, elapsed: float, hold: float) -> float:
        # One look counts at most a second, because a pause says nothing about the answer.
        looks = min(1.0, elapsed / self.settings.look)
        return min(min(1.0, elapsed) / hold, looks / self.settings.answers)

    def _event(self, kind: Kind, one: Track, since: float, detail: str | None = None) -> Event:
        return Event(kind, self._now, since, one.id, one.label, one.room, one.probability, detail)

    def _is_habit(self, track: Track) -> bool:
        return (track.label, track.room) in self.confirmed

    # -------------------------------------------------------------------------------- questions

    def _ask(self) -> Iterator[Event]:
        """Ask about the room of the robot if its things have changed, or its type is open."""
        if self._now < self._next:
            return
        things, room = self._things(self.room), self._rooms[self.room]
        is_new = self._lost is not None or self._asked.differs(self.room, things)
        is_open = room.is_named is not True and (is_new or room.type.value is None)
        timeout = self.settings.timeout if self._lost is None else LOST_TIMEOUT
        try:
            if is_open and (likely := self._things(self.room, LIKELY)):
                self._ask_type(room, likely, timeout)
            if is_new and things:
                self._ask_outliers(room, things, timeout)
        except InvalidRequestError:
            raise
        except ClientError as error:
            if isinstance(error, ProblemError) and error.status == HTTPStatus.UNPROCESSABLE_ENTITY:
                self._asked.remember(self.room, things)  # the service knows none of the labels
                self._next = self._now + FIRST_PAUSE
                return
            if self._lost is None:
                yield Event("service", self._now, self._now, label="lost", detail=str(error))
            pause = FIRST_PAUSE if self._lost is None else min(LONGEST_PAUSE, 2 * self._lost)
            self._lost, self._next = pause, self._now + pause
            return
        if self._lost is not None and things:
            self._lost = None
            yield Event("service", self._now, self._now, label="back")
        self._next = self._now + self.settings.pause

    def _ask_type(self, room: Room, things: list[Track], timeout: float) -> None:
        objects = [one.as_object(self._tracks.shift) for one in things]
        fields: Any = {"candidates": self._candidates} if self._candidates else {}
        answer = self.client.rooms(
            objects, unknown_labels=UNKNOWN, detail="scores", timeout=timeout, **fields
        )
        types = {one.room_type: one.probability for one in answer.room_types}
        best = max(types, key=types.__getitem__, default=None)
        if best is not None and types[best] - types.get(room.best or "", 0.0) > MARGIN:
            room.best = best
        room.probability = types.get(room.best or "", 0.0)

    def _ask_outliers(self, room: Room, things: list[Track], timeout: float) -> None:
        scene = self._scene(things, self.room) | {"sensitivity": self.settings.sensitivity}
        answer = self.client.outliers(**scene, timeout=timeout)
        if "room_type" in scene and room.is_named is None:
            guessed = [one.label for one in answer.mapped if one.similarity < 1]
            room.is_named = self.room not in (*answer.ignored, *guessed)
        self._asked.remember(self.room, things)
        moved = {one.moved or one.subject: one for one in answer.misplaced if one.is_misplaced}
        for one in answer.outliers:
            if (track := self._tracks.all.get(one.object)) is None:
                continue
            track.probability = one.probability
            if one.is_outlier:
                track.verdict = "out-of-place"
            elif one.object in moved:
                track.verdict, track.probability = "misplaced", moved[one.object].probability
            elif one.reason == "misdetection":
                track.verdict, track.probability = "misdetection", 1 - (one.real or 0.0)

    @property
    def alarms(self) -> list[Event]:
        """The alarms that are on."""
        return [
            self._event(cast(Kind, one.alarm.value), one, one.alarm.since)
            for one in self._tracks.all.values()
            if one.alarm.value is not None
        ]

    def things(self, room: str | None = None) -> list[Track]:
        """Return the present things of a room, by default of the whole home."""
        present = [one for one in self._tracks.all.values() if one.is_confirmed]
        return present if room is None else [one for one in present if one.room == room]

    def room_type(self, room: str | None = None) -> str | None:
        """Return the type of a room, by default of the robot's room, or else the likeliest one."""
        known = self._rooms.get(name := self.room if room is None else room, Room())
        return known.settled_type(name) or known.best

    def coverage(self, room: str | None = None) -> float:
        """Return the share of a room that the robot has seen, from .2 at first sight to .9."""
        return self._rooms.get(self.room if room is None else room, Room()).coverage

    def scene(self, room: str | None = None) -> dict[str, Any]:
        """Return the fields of a request about a room, by default about the robot's room."""
        name = self.room if room is None else room
        return self._scene(self._things(name), name)

    def _scene(self, things: Iterable[Track], room: str) -> dict[str, Any]:
        objects = [one.as_object(self._tracks.shift) for one in things]
        scene: dict[str, Any] = {"objects": objects, "unknown_labels": UNKNOWN}
        if any("position" in one for one in objects):
            scene["frame_id"] = "map"
            if self._pose is not None:
                scene["viewpoint"] = self._viewpoint(self._pose)
        is_word = 0 < len(room.strip()) <= schemas.MAX_LABEL and room.isprintable()
        if is_word and self._rooms.get(room, Room()).is_named is not False:
            scene["room_type"] = room
        return scene

    def _viewpoint(self, pose: Vector) -> dict[str, float]:
        return dict(zip(("x", "y", "yaw"), plus(pose, self._tracks.shift), strict=True))

    def _things(self, room: str, exists: float | None = None) -> list[Track]:
        """Return the most certain (present) things of a room, or without rooms of those nearby."""
        here = None if room else self._pose
        found = [
            one
            for one in self._tracks.all.values()
            if one.room == room
            and (one.is_confirmed if exists is None else one.exists >= exists)
            and (not here or not one.place or math.dist(one.place[:2], here[:2]) <= NEAR)
        ]
        return sorted(found, key=lambda one: -one.confidence)[:MOST_THINGS]

    def thing(self, track_id: str) -> dict[str, Any]:
        """Return a thing as an object of a request, with its position in the frame ``map``.

        Raises:
            UnknownThingError: the home has no such thing.
        """
        return self._track(track_id).as_object(self._tracks.shift)

    def _track(self, track_id: str) -> Track:
        if (track := self._tracks.all.get(track_id)) is None:
            raise UnknownThingError(f"the home has no thing {track_id!r}, or it is gone")
        return track

    def missing(self, room: str | None = None, **fields: Any) -> schemas.MissingAnswer:
        """Ask which things a room lacks. Other fields are those of `Client.missing`."""
        scene = {**self.scene(room), "coverage": self.coverage(room)}
        return self.client.missing(**{**scene, **fields})

    def where(
        self, label: str, searched: Iterable[schemas.Searched | schemas.Body] = (), **fields: Any
    ) -> schemas.WhereAnswer:
        """Ask where in the home a thing is. Other fields are those of `Client.where`."""
        home = self._state.where_fields() | {"searched": list(searched)}
        if self._pose is not None and "frame_id" in home:
            home["viewpoint"] = self._viewpoint(self._pose)
        return self.client.where(label, **{**home, **fields})

    def confirm(self, track_id: str) -> list[Event]:
        """State that a thing belongs where it is. Return the alarms that this clears.

        Things of this label in this room raise no alarm from now on. The file of the home is
        written at once. With ``record``, the scene of the room is recorded as confirmed, without
        the things of other alarms.

        Raises:
            UnknownThingError: the home has no such thing.
        """
        track, events = self._track(track_id), list[Event]()
        self.confirmed.add((track.label, track.room))
        for one in self._tracks.all.values():
            if self._is_habit(one) and one.alarm.value is not None:
                former, one.alarm = one.alarm.value, Latch()
                events.append(self._event("cleared", one, self._now, former))
        if self.path is not None:
            self._try_save()  # the robot may stop before its next frame
        if self._recorder is not None:
            quiet = [one for one in self._things(track.room) if one.alarm.value is None]
            kind = self._rooms.get(track.room, Room()).settled_type(track.room)
            scene = self._scene(quiet, track.room) | {"confirmed": True, "room_type": kind}
            self._recorder.confirm(schemas.SceneRequest.model_validate(scene))
        return events

    # --------------------------------------------------------------------------------- the file

    def save(self, path: str | os.PathLike[str] | None = None) -> None:
        """Write the home to a file, by default to its own. A crash leaves the old file.

        Raises:
            OSError: the file cannot be written.
        """
        if (target := path or self.path) is None:
            raise ValueError("the home has no file: name a path")
        write_state(self._state, Path(target))

    @property
    def _state(self) -> State:
        now, tracks = self._now if math.isfinite(self._now) else None, self._tracks
        return State(
            now, self.room, tracks.shift, tracks.count, self.confirmed, self._rooms, tracks.all
        )

    def _resume(self, state: State) -> None:
        self.room, self.confirmed = state.room, state.habits
        self._tracks.shift, self._tracks.count = state.shift, state.count
        self._rooms |= state.rooms
        for track in state.tracks.values():
            is_renamed = track.room not in self._plan.rooms  # if there are any
            if self._plan.rooms and track.place is not None and is_renamed:
                track.room = self._room_of(track.place, "")  # its room has another name now
            self._tracks.add(track)
        self._now = self._saved = -math.inf if state.stamp is None else state.stamp

    def _try_save(self) -> None:
        self._saved = self._now
        try:
            self.save()
        except OSError as error:
            _logger.warning("cannot save the home in %s: %s", self.path, error)

    def close(self) -> None:
        """Save the home to its file. The end of the program does so too."""
        if self.path is not None:
            atexit.unregister(self.close)
            self._try_save()

    def __exit__(self, *_: object) -> None:
        self.close()
