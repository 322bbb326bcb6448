"""Record the scenes of questions in the training format, one JSON object a line.

docs/own-home.md shows how to correct the file and adapt a model with it. docs/clients.md describes
which scenes are written.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import stat
import threading
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from time import monotonic, sleep
from typing import TYPE_CHECKING, Any, Final

from pydantic_core import to_json

from scene_client.errors import InvalidRequestError
from scene_client.recorded_scene import ON_TOP, Time, Triple, likely, scene_of, time_of

try:
    import fcntl
except ImportError:  # Windows, where only one process may write a file
    fcntl = None  # type: ignore[assignment]

if TYPE_CHECKING:
    from scene_client.schemas import Detection, SceneRequest

MOST_BYTES: Final = 64 * 2**20
"""Default for the maximum size of the file. The older file has at most the same size."""

LEAST_OBJECTS: Final = 2
"""Scenes with fewer objects are not written, because they show no objects that occur together."""

STEP: Final = 0.5
"""An object has moved if its centre is in another cell of a grid with this width in metres."""

PAUSE: Final = 60.0
"""Seconds until a scene whose objects have only moved is written again."""

REMEMBERED: Final = 4096
"""Number of remembered hashes. Each scene has a hash of its labels, and up to two further ones."""

MOST_WAITING: Final = 64
"""Maximum number of scenes that wait for the thread. Then `record` waits for the oldest scene."""

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

    `record` only decides which scenes are new. One thread of the recorder converts and writes them.

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
        self._is_failing = False
        self._start()
        self._recall()

    def record(self, requests: Iterable[SceneRequest]) -> None:
        """Write the new scenes among those of the requests, in the thread of the recorder."""
        if self._process != os.getpid():
            self._start()
        for request in requests:
            time, entries = time_of(request), likely(request)
            labels = [entry if isinstance(entry, str) else entry.label for entry in entries]
            if len(labels) < LEAST_OBJECTS:
                continue
            hashes = _hashes(time[0], labels, request.room_type, _stated(request, entries))
            with self._lock:
                if not self._is_new(hashes, request):
                    continue
                self._remember(hashes, _places(request))
            self._waiting.acquire()
            try:
                self._thread.submit(self._write, request, time, hashes)
            except RuntimeError:  # no thread can start, for example at the end of the program
                self._write(request, time, hashes)

    def flush(self) -> None:
        """Wait until the scenes are written. The end of the program waits too."""
        if self._process == os.getpid():
            with suppress(RuntimeError):  # no thread can start, so no scene waits
                self._thread.submit(int).result()

    def _start(self) -> None:
        """Make a thread and its locks. After a fork, the locks may be locked without a thread."""
        self._process, self._lock = os.getpid(), threading.Lock()
        self._thread = ThreadPoolExecutor(1, "scene-recorder")
        self._waiting = threading.Semaphore(MOST_WAITING)

    def _write(self, request: SceneRequest, time: Time, hashes: Sequence[int]) -> None:
        try:
            self._append(scene_of(request, time))
            self._is_failing = False
        except (OSError, ValueError) as error:
            if not self._is_failing:
                _logger.warning("cannot record scenes in %s: %s", self.path, error)
            self._is_failing = True
            with self._lock:
                for key in hashes:
                    self._recent.pop(key, None)
        finally:
            self._waiting.release()

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
        line = to_json(scene) + b"\n"
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
            if _lock(file, path):
                yield file
                return
        finally:
            if fcntl is not None:  # a fork in another thread may keep a copy of the open file
                fcntl.flock(file, fcntl.LOCK_UN)
            os.close(file)
        if monotonic() >= ends:
            raise OSError(errno.EWOULDBLOCK, "another program has locked the file")
        sleep(_LONGEST_WAIT / 10)


def _lock(file: int, path: Path) -> bool:
    """Lock an open file, unless another writer has locked or renamed it."""
    try:
        if fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        status = os.fstat(file)
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.EINVAL, "not a regular file")
        return os.path.samestat(status, path.stat())
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
        elif one.relation in ON_TOP:
            upper, lower = (subject, anchor) if one.relation == "on-top" else (anchor, subject)
            relations.append((upper, "on-top", lower))
    return relations


def _places(request: SceneRequest) -> int:
    """Return a hash of the labels and their cells."""
    cells = [
        (entry.label, at.x // STEP, at.y // STEP, at.z // STEP)
        for entry in likely(request)
        if not isinstance(entry, str) and (at := entry.position) is not None
    ]
    return hash(tuple(sorted(cells)))
