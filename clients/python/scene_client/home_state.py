"""The events and rooms of a home, and the file from which it resumes after a restart."""

from __future__ import annotations

import errno
import math
import os
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from pydantic import TypeAdapter
from pydantic_core import from_json

from scene_client import schemas
from scene_client.errors import HomeFileError
from scene_client.home_settings import Latch
from scene_client.tracks import Place, Track, Vector
from scene_client.untrusted import printable, read_regular

FORMAT: Final = "scene-home"
VERSION: Final = 1  # of the file
UNKNOWN: Final = "nearest-or-ignore"  # treatment of unknown labels
MOST_THINGS, MOST_ROOMS = 256, schemas.MAX_ROOMS  # of a room in a request, and of a home
MOST_BYTES: Final = 2**23  # of the file; 10,000 things have 5 MB
_MOST: Final = 1e12  # absolute value of a number in the file; times have 2e9
_LONGEST: Final = 256  # characters of a text in the file
HEADINGS, LOOKS = 8, 30  # directions, or looks without poses, that show a whole room

Kind = Literal[
    "appeared", "gone", "relabelled", "out-of-place", "misplaced", "misdetection", "cleared",
    "room", "service",
]  # fmt: skip


@dataclass(frozen=True)
class Event:
    """One change of a home, or an alarm that is on."""

    kind: Kind
    stamp: float  # time of the change
    since: float  # start of what the event reports
    id: str | None = None  # track of the thing
    label: str | None = None  # of the thing; type of the room; service `lost` or `back`
    room: str = ""  # name of the room; empty without names
    probability: float | None = None  # in the last answer
    detail: str | None = None  # the former alarm, label or type; the error of the service


@dataclass
class Room:
    """What a home knows about one room."""

    type: Latch = field(default_factory=Latch)
    best: str | None = None  # likeliest type in the last answer
    probability: float = 0.0  # of this type
    is_named: bool | None = None  # whether the name is a room type; None before the first answer
    headings: set[int] = field(default_factory=set)  # directions of the looks
    looks: float = 0.0  # number of looks without a pose

    def look(self, pose: Vector | None, weight: float) -> None:
        """Count a look."""
        if pose is None:
            self.looks += weight
        else:
            self.headings.add(math.floor(pose[2] / math.tau * HEADINGS) % HEADINGS)

    @property
    def coverage(self) -> float:
        """Share of the room that the robot has seen."""
        return 0.2 + 0.7 * min(1.0, max(len(self.headings) / HEADINGS, self.looks / LOOKS))

    def settled_type(self, name: str) -> str | None:
        """Return the type of the room with this name, if it is certain."""
        return name if self.is_named else self.type.value


class Asked:
    """What the last question about each room was about. `step` is the least change of a thing."""

    def __init__(self, step: float) -> None:
        self.step = step
        self._things: dict[str, dict[str, tuple[str, float, Vector | None]]] = {}

    def differs(self, room: str, things: Sequence[Track]) -> bool:
        """Return whether the things of a room have changed since the last question."""
        asked = self._things.get(room, {})
        if asked.keys() != {one.id for one in things}:
            return True
        for one in things:
            label, confidence, place = asked[one.id]
            has_moved = place and one.place and math.dist(place, one.place) > self.step
            if label != one.label or abs(confidence - one.confidence) > self.step or has_moved:
                return True
        return False

    def remember(self, room: str, things: Iterable[Track]) -> None:
        """Remember what a question is about. The verdicts of its answer follow."""
        self._things[room] = {}
        for one in things:
            self._things[room][one.id] = (one.label, one.confidence, one.place)
            one.verdict = None


def seconds_of(stamp: float | schemas.Stamp | schemas.Body | None) -> float:
    """Return a stamp in seconds, by default the time of the computer's clock."""
    if stamp is None:
        return time.time()
    if isinstance(stamp, int | float):
        return float(stamp)
    whole = schemas.Stamp.model_validate(stamp, from_attributes=True)
    return whole.sec + whole.nanosec * 1e-9


@dataclass
class State:
    """The contents of the file of a home."""

    stamp: float | None = None  # time of the last frame
    room: str = ""  # room of the robot
    shift: Place = (0.0, 0.0, 0.0)  # of the map
    count: int = 0  # number of all tracks, also of ended ones
    habits: set[tuple[str, str]] = field(default_factory=set)  # label and room
    rooms: dict[str, Room] = field(default_factory=dict)
    tracks: dict[str, Track] = field(default_factory=dict)
    format: Literal["scene-home"] = FORMAT
    version: int = VERSION

    def where_fields(self) -> dict[str, Any]:
        """Return the fields of a `where` request about the present things, without a label."""
        fields: dict[str, Any] = {"rooms": [], "unknown_labels": UNKNOWN}
        things: dict[str, list[Track]] = {name: [] for name in self.rooms if name}
        for track in sorted(self.tracks.values(), key=lambda one: -one.confidence):
            if track.is_confirmed:
                things.setdefault(track.room, []).append(track)
        names = sorted(things, key=lambda name: -len(things[name]))[:MOST_ROOMS]
        left = schemas.MAX_THINGS
        for name in names:
            present = things[name][: min(MOST_THINGS, left)]
            left -= len(present)
            objects = [one.as_object(self.shift) for one in present]
            known = self.rooms.get(name, Room())
            here = "here" if "here" not in things else "elsewhere"
            room = {"id": name or here, "objects": objects, "coverage": known.coverage}
            if (kind := known.settled_type(name)) is not None:
                room["room_type"] = kind
            fields["rooms"].append(room)
            if any("position" in one for one in objects):
                fields["frame_id"] = "map"
        return fields


_FILE: Final = TypeAdapter(State)


def write_state(state: State, path: Path) -> None:
    """Replace the file of a home. A reader, or a crash, never sees a part of it.

    Raises:
        OSError: the file cannot be written, or would be larger than `read_state` accepts.
    """
    sibling, content = path.with_name(f".{path.name}.{os.getpid()}"), _FILE.dump_json(state)
    if len(content) > MOST_BYTES:
        raise OSError(errno.EFBIG, f"the home has more than {MOST_BYTES} bytes")
    try:
        with sibling.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        sibling.replace(path)
    finally:
        sibling.unlink(missing_ok=True)


def read_state(path: Path) -> State:
    """Return the contents of the file of a home, or an empty state if there is no file.

    Raises:
        HomeFileError: the file is damaged, or of a newer version.
    """
    try:
        return state_of(from_json(read_regular(path, MOST_BYTES)), path)
    except FileNotFoundError:
        return State()
    except (OSError, ValueError) as error:
        if isinstance(error, HomeFileError):
            raise
        raise _damaged(path, error) from None


def state_of(data: Any, path: str | os.PathLike[str]) -> State:
    """Return the contents of the file of a home from its parsed JSON.

    Raises:
        HomeFileError: the file is damaged, or of a newer version.
    """
    try:
        version = data["version"]
        if version <= VERSION:
            _require_plain(data)
            return _FILE.validate_python(data)
    except (LookupError, TypeError, ValueError) as error:
        raise _damaged(path, error) from None
    raise HomeFileError(
        f"{path} has version {version}, but this client reads up to version {VERSION}. Install a "
        "newer client, or name another file. It is left as it is."
    )


def _require_plain(data: Any) -> None:
    """Raise ValueError for a number or a text that no home has, and that would stop the robot."""
    nodes = [data]
    for node in nodes:
        if isinstance(node, dict):
            nodes += [*node, *node.values()]
        elif isinstance(node, list):
            nodes += node
        elif isinstance(node, str) and not (node.isprintable() and len(node) <= _LONGEST):
            raise ValueError(f"the text {printable(node[:40])} is not plain")
        elif isinstance(node, int | float) and not abs(node) <= _MOST:
            raise ValueError("a number is not finite, or out of range")


def _damaged(path: str | os.PathLike[str], error: Exception) -> HomeFileError:
    reason = str(error).partition("\n")[0]
    return HomeFileError(
        f"{path} is not a whole file of a home ({type(error).__name__}: {reason}). Restore it, or "
        "name another file. It is left as it is."
    )
