"""Record the scenes of questions in the training format, one JSON object a line.

docs/own-home.md shows how to correct the file and adapt a model with it. docs/clients.md describes
which scenes are written.
"""

from __future__ import annotations

import errno
import json
import logging
import math
import os
import stat
import threading
from collections import Counter, OrderedDict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from secrets import token_hex
from time import localtime, monotonic, sleep, strftime, time_ns
from typing import TYPE_CHECKING, Any, Final

from scene_client.errors import InvalidRequestError
from scene_client.frames import body_pose, is_optical, is_world_fixed

try:
    import fcntl
except ImportError:  # Windows, where only one process may write a file
    fcntl = None  # type: ignore[assignment]

if TYPE_CHECKING:
    from scene_client.schemas import Detection, SceneRequest, Viewpoint

MOST_BYTES: Final = 64 * 2**20
"""Default for the maximum size of the file. The older file has at most the same size."""

LEAST_CONFIDENCE: Final = 0.5
"""Objects with a lower confidence are left out of a scene."""

LEAST_OBJECTS: Final = 2
"""Scenes with fewer objects are not written, because they show no objects that occur together."""

STEP: Final = 0.5
"""An object has moved if its centre is in another cell of a grid with this width in metres."""

PAUSE: Final = 60.0
"""Seconds until a scene whose objects have only moved is written again."""

REMEMBERED: Final = 4096
"""Number of remembered hashes. Each scene has a hash of its labels, and up to two further ones."""

# A named pipe must not block, and Windows must not convert line ends.
_OF_THE_SYSTEM: Final = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
_FLAGS: Final = os.O_RDWR | os.O_APPEND | os.O_CREAT | _OF_THE_SYSTEM
_LONGEST_WAIT: Final = 0.01  # seconds for the lock of the file
_LONGEST_LINE: Final = 8 * 2**20  # bytes; the training refuses longer lines
_TAIL: Final = 2**16  # bytes that are read at once from the end of the file

_logger: Final = logging.getLogger(__name__)


class Recorder:
    """Writer of a file with one scene per line, which several threads and processes may share.

    A scene is written if its labels are new within the hour, or its room type, its stated
    relations, or the places of its objects. For new places alone, `PAUSE` must have passed.

    If the file would become larger than `most_bytes`, it becomes the older file: ``scenes.jsonl``
    is renamed to ``scenes.old.jsonl``, and an earlier older file is deleted. An error never reaches
    the caller. The recorder logs one warning, and tries again with the next scene.

    Args:
        path: the file, which only its owner can read if the recorder creates it.
        most_bytes: maximum size of the file in bytes.

    Raises:
        InvalidRequestError: the name of the file does not end in ``.jsonl``.
    """

    def __init__(self, path: str | os.PathLike[str], *, most_bytes: int = MOST_BYTES) -> None:
        self.path = Path(path).absolute()
        if self.path.suffix != ".jsonl":
            message = "the name of a file with recorded scenes must end in .jsonl"
            raise InvalidRequestError.about(message)
        self.older = self.path.with_suffix(f".old{self.path.suffix}")
        self.most_bytes = most_bytes
        # Hashes of the newest scenes, in order of use, with a hash of the places and the time of
        # the last comparison of places.
        self._recent: OrderedDict[int, tuple[int, float]] = OrderedDict()
        self._lock, self._process = threading.Lock(), os.getpid()
        self._is_failing = False
        self._recall()

    def record(self, requests: Iterable[SceneRequest]) -> None:
        """Write the new scenes among those of the requests."""
        if self._process != os.getpid():  # a fork may have copied a locked lock
            self._lock, self._process = threading.Lock(), os.getpid()
        for request in requests:
            try:
                self._record(request)
            except (OSError, ValueError) as error:
                if not self._is_failing:
                    _logger.warning("cannot record scenes in %s: %s", self.path, error)
                self._is_failing = True

    def _record(self, request: SceneRequest) -> None:
        entries = _likely(request)
        labels = [entry if isinstance(entry, str) else entry.label for entry in entries]
        if len(labels) < LEAST_OBJECTS:
            return
        hour, _ = _time_of(request)
        hashes = _hashes(hour, labels, request.room_type, _stated(request, entries))
        with self._lock:
            if self._is_new(hashes, request):
                self._append(scene_of(request))
                self._remember(hashes, _places(request))
                self._is_failing = False

    def _is_new(self, hashes: Sequence[int], request: SceneRequest) -> bool:
        if not all(key in self._recent for key in hashes):
            return True
        for key in hashes:
            self._recent.move_to_end(key)
        places, checked = self._recent[hashes[0]]
        if monotonic() - checked < PAUSE:
            return False
        self._recent[hashes[0]] = (places, monotonic())
        return places != _places(request)

    def _remember(self, hashes: Sequence[int], places: int) -> None:
        self._recent.update(dict.fromkeys(hashes, (places, monotonic())))
        while len(self._recent) > REMEMBERED:
            self._recent.popitem(last=False)

    def _recall(self) -> None:
        """Remember the last scenes of the file, so that another run does not repeat them."""
        try:
            if not self.path.is_file():  # opening a named pipe would block
                return
            with self.path.open("rb") as file:
                file.seek(max(0, file.seek(0, os.SEEK_END) - _TAIL))
                lines = file.read().split(b"\n")
        except OSError:
            return
        for line in lines:
            try:
                self._remember(_hashes_of_line(json.loads(line)), 0)
            except (AttributeError, LookupError, TypeError, ValueError):
                continue  # a line of another program, or a part of a line

    def _append(self, scene: dict[str, Any]) -> None:
        """Append a scene to the file, or to a new file if this file would become too large."""
        line = (json.dumps(scene, ensure_ascii=False, separators=(",", ":")) + "\n").encode()
        if len(line) > _LONGEST_LINE:
            raise ValueError(f"a scene has more than {_LONGEST_LINE} bytes")
        with _locked(self.path) as file:
            size = _mend(file)
            if not size or size + len(line) <= self.most_bytes:
                _write(file, size, line)
                return
            self.path.replace(self.older)
        with _locked(self.path) as file:
            _write(file, _mend(file), line)


# ---------------------------------------------------------------------------------- the file


@contextmanager
def _locked(path: Path) -> Iterator[int]:
    """Open the file for appending, create it if necessary, and lock it for other writers.

    Raises:
        OSError: the file cannot be opened, is not regular, or is locked for too long.
    """
    ends = monotonic() + _LONGEST_WAIT
    while True:
        file = os.open(path, _FLAGS, 0o600)
        try:
            if not stat.S_ISREG(os.fstat(file).st_mode):
                raise OSError(errno.EINVAL, "not a regular file")
            if _lock(file, path):
                yield file
                return
        finally:
            os.close(file)
        if monotonic() >= ends:
            raise OSError(errno.EWOULDBLOCK, "another program has locked the file")
        sleep(_LONGEST_WAIT / 10)


def _lock(file: int, path: Path) -> bool:
    """Lock an open file, unless another writer has locked or renamed it."""
    try:
        if fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return os.path.samestat(os.fstat(file), path.stat())
    except (BlockingIOError, FileNotFoundError):
        return False


def _mend(file: int) -> int:
    """End the last line of a file, or cut it off if a crash left a part of a scene.

    Returns:
        size of the file in bytes.
    """
    size = os.lseek(file, 0, os.SEEK_END)
    start, tail = size, b""
    while start and b"\n" not in tail and len(tail) < _LONGEST_LINE:
        # One byte is enough to see that the last line is complete.
        step = min(start, _TAIL if tail else 1)
        start = os.lseek(file, start - step, os.SEEK_SET)
        tail = os.read(file, step) + tail
    tail = tail.rpartition(b"\n")[2]
    if not tail:
        return size
    try:
        json.loads(tail)
    except ValueError:
        if tail.startswith(b"{"):
            os.ftruncate(file, size - len(tail))
            return size - len(tail)
    return size + os.write(file, b"\n")


def _write(file: int, size: int, line: bytes) -> None:
    """Append a line to a file of this size, as a whole or not at all."""
    if os.write(file, line) < len(line):
        os.ftruncate(file, size)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


# --------------------------------------------------------------------------------- the scene


def scene_of(request: SceneRequest) -> dict[str, Any]:
    """Return the scene of a request in the training format.

    Positions are in the axes of the viewer, except in world-fixed frames without a viewpoint. The
    training takes unlisted relations for false, so relations are listed only if the request states
    all of them. Otherwise, on-top becomes `supported_by`, and the other relations are left out.
    """
    hour, stamp = _time_of(request)
    scene: dict[str, Any] = {"scene_id": f"{hour}-{token_hex(8)}", "group": hour}
    if request.room_type is not None:
        scene["room_type"] = request.room_type
    entries = _likely(request)
    optical = is_optical(request.frame_id)
    objects = {
        name: _object(name, entry, request.viewpoint, optical=optical)
        for name, entry in zip(_ids(entries), entries, strict=True)
    }
    labels = Counter(thing["label"] for thing in objects.values())
    names = {thing["label"]: name for name, thing in objects.items() if labels[thing["label"]] == 1}
    names |= {name: name for name in objects}
    relations = [
        [names[one.subject], one.relation, names[one.object]]
        for one in request.relations or ()
        if one.subject in names and one.object in names
    ]
    for subject, relation, anchor in () if request.relations_complete else relations:
        if relation in _ON_TOP:
            upper, lower = (subject, anchor) if relation == "on-top" else (anchor, subject)
            objects[upper].setdefault("supported_by", lower)
    for thing in objects.values():
        if "supported_by" in thing and (support := names.get(thing.pop("supported_by"))):
            thing["supported_by"] = support
    scene["objects"] = list(objects.values())
    if request.relations_complete:
        supports = [
            [thing["id"], "on-top", thing["supported_by"]]
            for thing in objects.values()
            if "supported_by" in thing
        ]
        scene["relations"] = relations + [one for one in supports if one not in relations]
    if any("position" in thing for thing in scene["objects"]):
        has_viewer = request.viewpoint is not None or not is_world_fixed(request.frame_id)
        scene["viewer_frame"] = has_viewer
    return scene | {"stamp": stamp}


Triple = tuple[str, str, str]
_ON_TOP: Final = ("on-top", "under")


def _time_of(request: SceneRequest) -> tuple[str, dict[str, int]]:
    """Return the hour in local time, which is the group of the scene, and the stamp."""
    if request.stamp is None:
        second, nanosecond = divmod(time_ns(), 10**9)
    else:
        second, nanosecond = request.stamp.sec, request.stamp.nanosec
    return strftime("%Y-%m-%dT%H", localtime(second)), {"sec": second, "nanosec": nanosecond}


def _likely(request: SceneRequest) -> list[str | Detection]:
    """Return the objects that are recorded."""
    return [
        entry
        for entry in request.objects
        if isinstance(entry, str) or entry.confidence >= LEAST_CONFIDENCE
    ]


def _ids(objects: Sequence[str | Detection]) -> list[str]:
    """Return distinct ids, as the service chooses them."""
    stated = [None if isinstance(entry, str) else entry.id for entry in objects]
    labels = [entry if isinstance(entry, str) else entry.label for entry in objects]
    used = {name for name in stated if name is not None}
    bare = Counter(label for label, name in zip(labels, stated, strict=True) if name is None)
    ids = []
    for name, label in zip(stated, labels, strict=True):
        own, number = label if name is None else name, 0
        while name is None and (own in used or (bare[label] > 1 and not number)):
            number += 1
            own = f"{label}_{number}"
        used.add(own)
        ids.append(own)
    return ids


def _object(
    name: str, entry: str | Detection, view: Viewpoint | None, *, optical: bool
) -> dict[str, Any]:
    """Return an object in the training format. `supported_by` is an id or a label."""
    if isinstance(entry, str):
        return {"id": name, "label": entry}
    thing: dict[str, Any] = {"id": name, "label": entry.label}
    size = None if entry.size is None else (entry.size.x, entry.size.y, entry.size.z)
    yaw = 0.0
    if (centre := entry.position) is not None:
        turn = None
        if entry.yaw is not None:
            turn = (0.0, 0.0, math.sin(entry.yaw / 2), math.cos(entry.yaw / 2))
        elif (q := entry.orientation) is not None:
            turn = (q.x, q.y, q.z, q.w)
        place, size, yaw = body_pose((centre.x, centre.y, centre.z), size, turn, optical=optical)
        if view is not None:
            cos, sin = math.cos(view.yaw), math.sin(view.yaw)
            x, y = place[0] - view.x, place[1] - view.y
            place, yaw = (x * cos + y * sin, y * cos - x * sin, place[2]), yaw - view.yaw
        thing["position"] = _rounded(place)
    if size is not None:
        thing["size"] = _rounded(size)
    if yaw:
        thing["yaw"] = round(math.remainder(yaw, math.tau), 4)
    if entry.supported_by is not None:
        thing["supported_by"] = entry.supported_by
    return thing


def _rounded(vector: Iterable[float]) -> list[float]:
    return [round(value, 4) + 0.0 for value in vector]  # 0.0 in place of -0.0


# ------------------------------------------------------------------------------ known scenes


def _hashes(
    hour: str, labels: Iterable[str], room: str | None, relations: Iterable[Triple]
) -> list[int]:
    """Return hashes of the labels, the room type and the relations between labels."""
    hashes = [hash((hour, *sorted(labels)))]
    if room is not None:
        hashes.append(hash((hashes[0], room)))
    if relations := sorted(set(relations)):
        hashes.append(hash((hashes[0], *relations)))
    return hashes


def _hashes_of_line(scene: dict[str, Any]) -> list[int]:
    label_of = {thing["id"]: thing["label"] for thing in scene["objects"]}
    supports = [
        (thing["id"], "on-top", thing["supported_by"])
        for thing in scene["objects"]
        if "supported_by" in thing
    ]
    triples = (*(scene.get("relations") or ()), *supports)
    relations = [(label_of[i], name, label_of[j]) for i, name, j in triples]
    return _hashes(scene["group"], label_of.values(), scene.get("room_type"), relations)


def _stated(request: SceneRequest, entries: Sequence[str | Detection]) -> list[Triple]:
    """Return the recorded ones of the stated relations, as triples of labels."""
    detections = [entry for entry in entries if not isinstance(entry, str)]
    label_of = {entry.id: entry.label for entry in detections if entry.id is not None}
    relations = [
        (entry.label, "on-top", label_of.get(entry.supported_by, entry.supported_by))
        for entry in detections
        if entry.supported_by is not None
    ]
    for one in request.relations or ():
        subject, anchor = (label_of.get(name, name) for name in (one.subject, one.object))
        if request.relations_complete:
            relations.append((subject, one.relation, anchor))
        elif one.relation in _ON_TOP:
            upper, lower = (subject, anchor) if one.relation == "on-top" else (anchor, subject)
            relations.append((upper, "on-top", lower))
    return relations


def _places(request: SceneRequest) -> int:
    """Return a hash of the labels and their cells."""
    cells = [
        (entry.label, at.x // STEP, at.y // STEP, at.z // STEP)
        for entry in _likely(request)
        if not isinstance(entry, str) and (at := entry.position) is not None
    ]
    return hash(tuple(sorted(cells)))
