"""Record the scenes of questions in the training format, one JSON object a line.

docs/own-home.md shows how to correct the file and adapt a model with it. docs/clients.md describes
which scenes are written.
"""

from __future__ import annotations

import errno
import logging
import os
import stat
import threading
from collections import OrderedDict, deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from time import monotonic, sleep
from typing import TYPE_CHECKING, Final, TypeAlias

from pydantic_core import from_json, to_json

from scene_client.errors import InvalidRequestError
from scene_client.recorded_scene import ON_TOP, Thing, Time, Triple, likely, scene_of, time_of

try:
    import fcntl
except ImportError:  # Windows, where only one process may write a file
    fcntl = None  # type: ignore[assignment]

if TYPE_CHECKING:
    from scene_client.schemas import SceneRequest

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

DELAY: Final = 0.05
"""Seconds until the thread writes a new scene. Many scenes at once take less time for each."""

MOST_WAITING: Final = 64
"""Maximum number of scenes that wait for the thread. Then `record` itself writes them."""

# A named pipe must not block, and Windows must not convert line ends.
_OF_THE_SYSTEM: Final = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
_FLAGS: Final = os.O_RDWR | os.O_APPEND | os.O_CREAT | _OF_THE_SYSTEM
_LONGEST_WAIT: Final = 0.01  # seconds for the lock of the file
_LONGEST_LINE: Final = 8 * 2**20  # bytes; the training refuses longer lines
_TAIL: Final = 2**16  # bytes that are read at once from the end of the file

_logger: Final = logging.getLogger(__name__)

_Scenes: TypeAlias = deque[tuple[list[int], bytes]]  # hashes and lines


class Recorder:
    """Writer of a file with one scene per line, which several threads and processes may share.

    A scene is written if its labels are new within the hour, or its room type, its stated
    relations, or the places of its objects. For new places alone, `PAUSE` must have passed.

    `record` only decides which scenes are new. One thread of the recorder converts and writes them.
    If the file would become larger than `most_bytes`, it becomes the older file: ``scenes.jsonl``
    is renamed to ``scenes.old.jsonl``, and an earlier older file is deleted. An unreadable end of
    the file, such as a line of a crash, moves to ``scenes.jsonl.damaged``. An error never reaches
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
        self.damaged = self.path.with_name(f"{self.path.name}.damaged")
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
            time, things = time_of(request), likely(request)
            if len(things) < LEAST_OBJECTS:
                continue
            relations = [
                (one.subject, one.relation, one.object)
                for one in request.relations or ()
                if request.relations_complete or one.relation in ON_TOP
            ]
            hashes = _hashes(time[0], things, request.room_type, relations)
            with self._lock:
                if not self._is_new(hashes, things):
                    continue
            self._waiting.append((hashes, request, time, things))
            if len(self._waiting) >= MOST_WAITING:
                self.flush()
        if self._waiting and self._is_due.is_set():
            self._is_due.clear()
            try:
                self._thread.submit(self._write_later)
            except RuntimeError:  # no thread can start, for example at the end of the program
                self.flush()

    def confirm(self, request: SceneRequest) -> str | None:
        """Write a scene that a person has confirmed, also if it is not new, before the return.

        Return its id in the file, or None if an error prevented the writing.
        """
        if self._process != os.getpid():
            self._start()
        self.flush()
        scene = scene_of(request, things=likely(request, 0.0)) | {"confirmed": True}
        scenes: _Scenes = deque([([], to_json(scene) + b"\n")])
        with self._writing:
            while scenes:
                self._append(scenes)
            return None if self._is_failing else str(scene["scene_id"])

    def flush(self) -> None:
        """Write the waiting scenes. The end of the program writes them too."""
        if self._process != os.getpid():
            return  # the scenes wait in the parent process
        self._is_due.set()
        with self._writing:
            scenes: _Scenes = deque()
            for _ in range(len(self._waiting)):
                hashes, request, time, things = self._waiting.popleft()
                scenes.append((hashes, to_json(scene_of(request, time, things)) + b"\n"))
            while scenes:
                self._append(scenes)

    def _start(self) -> None:
        """Make a thread and the locks. After a fork, they may be locked without a thread."""
        self._process = os.getpid()
        self._lock, self._writing = threading.Lock(), threading.Lock()  # of hashes, of the file
        self._thread = ThreadPoolExecutor(1, "scene-recorder")
        self._waiting: deque[tuple[list[int], SceneRequest, Time, list[Thing]]] = deque()
        # While the event is not set, the thread delays the waiting scenes.
        self._is_due = threading.Event()
        self._is_due.set()

    def _write_later(self) -> None:
        self._is_due.wait(DELAY)
        self.flush()

    def _is_new(self, hashes: Sequence[int], things: Sequence[Thing]) -> bool:
        before = None
        if all(key in self._recent for key in hashes):
            for key in hashes:
                self._recent.move_to_end(key)
            before, checked = self._recent[hashes[0]]
            if monotonic() - checked < PAUSE:
                return False
        places = _places(things)
        self._remember(hashes, places)
        return places != before

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
                scene = from_json(line)
                room, relations = scene.get("room_type"), scene.get("relations") or ()
                self._remember(_hashes(scene["group"], scene["objects"], room, relations), 0)
            except (AttributeError, LookupError, TypeError, ValueError):
                continue  # a line of another program, or a part of a line

    def _append(self, scenes: _Scenes) -> None:
        """Write scenes until the file is full or an error occurs, and remove them from `scenes`."""
        try:
            with _locked(self.path) as file:
                size = self._mend(file)
                while scenes:
                    _, line = scenes[0]
                    if len(line) > _LONGEST_LINE:
                        raise ValueError(f"a scene has more than {_LONGEST_LINE} bytes")
                    if size and size + len(line) > self.most_bytes:
                        self.path.replace(self.older)
                        return
                    _write(file, size, line)
                    size += len(line)
                    scenes.popleft()
                    self._is_failing = False
        except (OSError, ValueError) as error:
            if not self._is_failing:
                _logger.warning("cannot record scenes in %s: %s", self.path, error)
            self._is_failing = True
            with self._lock:
                for key in scenes.popleft()[0]:
                    self._recent.pop(key, None)

    def _mend(self, file: int) -> int:
        """End the last line, or set it aside if it is unreadable. Return the size of the file."""
        size = os.lseek(file, 0, os.SEEK_END)
        start = _start_of_tail(file, size)
        if start == size:
            return size
        if _is_readable(file, start, size):
            return size + os.write(file, b"\n")
        is_full = self.damaged.is_file() and self.damaged.stat().st_size > self.most_bytes
        flags = (_FLAGS & ~os.O_APPEND) | os.O_TRUNC if is_full else _FLAGS
        with os.fdopen(os.open(self.damaged, flags, 0o600), "wb") as damaged:
            for at in range(start, size, _TAIL):
                os.lseek(file, at, os.SEEK_SET)
                damaged.write(os.read(file, min(_TAIL, size - at)))
            damaged.write(b"\n")
        os.ftruncate(file, start)
        message = "the last line of %s was unreadable: its %d bytes are in %s now"
        _logger.warning(message, self.path, size - start, self.damaged.name)
        return start


# ---------------------------------------------------------------------------------- the file


@contextmanager
def _locked(path: Path) -> Iterator[int]:
    """Open the file for appending, create it if necessary, and lock it for other writers."""
    deadline = monotonic() + _LONGEST_WAIT
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
        if monotonic() >= deadline:
            raise OSError(errno.EWOULDBLOCK, "another program has locked the file")
        sleep(_LONGEST_WAIT / 10)


def _lock(file: int, path: Path) -> bool:
    try:
        if fcntl is not None:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        status = os.fstat(file)
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.EINVAL, "not a regular file")
        return os.path.samestat(status, path.stat())
    except (BlockingIOError, FileNotFoundError):
        return False


def _start_of_tail(file: int, size: int) -> int:
    """Return the position after the last line break."""
    end = size
    while end:
        # One byte is enough to see that the last line is complete.
        start = max(0, end - (_TAIL if end < size else 1))
        os.lseek(file, start, os.SEEK_SET)
        if (found := os.read(file, end - start).rfind(b"\n")) >= 0:
            return start + found + 1
        end = start
    return 0


def _is_readable(file: int, start: int, size: int) -> bool:
    """Return whether the last line is JSON that the training accepts."""
    if size - start >= _LONGEST_LINE:
        return False
    os.lseek(file, start, os.SEEK_SET)
    try:
        from_json(os.read(file, size - start))
    except ValueError:  # also for nesting that is too deep
        return False
    return True


def _write(file: int, size: int, line: bytes) -> None:
    if os.write(file, line) < len(line):
        os.ftruncate(file, size)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _hashes(
    hour: str, things: Sequence[Thing], room: str | None, relations: Iterable[Triple]
) -> list[int]:
    hashes = [hash((hour, *sorted([one["label"] for one in things])))]
    if room is not None:
        hashes.append(hash((hashes[0], room)))
    label_of = {one.get("id"): one["label"] for one in things}
    stated = {
        (one["label"], "on-top", label_of.get(support, support))
        for one in things
        if (support := one.get("supported_by")) is not None
    }
    for one, name, other in relations:
        subject, anchor = label_of.get(one, one), label_of.get(other, other)
        stated.add((anchor, "on-top", subject) if name == "under" else (subject, name, anchor))
    if stated:
        hashes.append(hash((hashes[0], *sorted(stated))))
    return hashes


def _places(things: Sequence[Thing]) -> int:
    cells = [
        (one["label"], at.x // STEP, at.y // STEP, at.z // STEP)
        for one in things
        if (at := one.get("position")) is not None
    ]
    return hash(tuple(sorted(cells)))
