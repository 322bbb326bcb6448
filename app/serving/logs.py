"""Log formats: JSON lines or plain text, on standard error. Keys are masked in every line."""

import json
import logging
import os
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from queue import SimpleQueue
from time import sleep
from typing import Any, Final, Literal

import orjson

from app.settings import Settings
from scene_client.untrusted import printable, printable_json, printable_lines

_MASK: Final = "**********"


class _Plain(logging.Formatter):
    """Write each message on one line. Only a traceback has further lines."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802
        """Return the first line of a record."""
        return printable(super().formatMessage(record))


_PLAIN: Final = _Plain("%(asctime)s %(levelname)-8s %(process)d %(name)s: %(message)s")

MOST_LINES: Final = 10_000
"""Maximum number of lines that wait for the reader of the log, a few megabytes."""

_TOGETHER: Final = 1000  # lines that are written at once, at most
# Time in seconds between two writes. Each write stops the event loop for some 50 microseconds.
_PAUSE: Final = 0.01
# Time in seconds that the end of the process waits for the reader of the log.
_PATIENCE: Final = 2.0

# No format shows the thread or the program of a record, and each takes time to find out.
logging.logThreads = logging.logMultiprocessing = False


def _json(record: logging.LogRecord) -> str:
    """Return a log record as a JSON object. Its attribute ``entry`` contains further fields."""
    entry: dict[str, Any] = {
        "time": datetime.fromtimestamp(record.created, UTC),
        "level": record.levelname.lower(),
        "process": record.process,
        "logger": record.name,
        "message": record.getMessage(),
        **getattr(record, "entry", {}),
    }
    if record.exc_info:
        entry["exception"] = _PLAIN.formatException(record.exc_info)
    try:
        return orjson.dumps(entry).decode()
    except TypeError:  # a text that is not valid Unicode
        return json.dumps(entry, default=str)


class Masked(logging.Formatter):
    """Write log records, and mask the secrets, which exception messages may contain."""

    def __init__(self, style: Literal["json", "plain"], secrets: Sequence[str] = ()) -> None:
        super().__init__()
        self._write = _json if style == "json" else _PLAIN.format
        # In a JSON line, a secret has the escaped form of a JSON string.
        self._secrets = [json.dumps(key)[1:-1] if style == "json" else key for key in secrets]

    def format(self, record: logging.LogRecord) -> str:
        """Return the log record as text, with the keys masked."""
        text = self._write(record)
        if not text.isprintable():  # orjson escapes the control characters of ASCII alone
            text = printable_json(text) if self._write is _json else printable_lines(text)
        for secret in self._secrets:
            text = text.replace(secret, _MASK)
        return text


class Lines(logging.Handler):
    """Write lines to standard error on a thread, so that the service never waits for their reader.

    While `MOST_LINES` lines wait, further lines are lost. A later line states their number.
    """

    def __init__(self) -> None:
        super().__init__()
        self._file = sys.stderr.fileno()
        self._queue = SimpleQueue[str | threading.Event]()
        self._lost = self._stated = 0  # lost lines since the start
        threading.Thread(target=self._write, name="log", daemon=True).start()

    def emit(self, record: logging.LogRecord) -> None:
        """Put the line of a record into the queue, or count it as lost."""
        if self._queue.qsize() >= MOST_LINES:
            self._lost += 1
            return
        try:
            self._queue.put(self.format(record))
        except Exception:  # noqa: BLE001 - an invalid record must not end a request
            self.handleError(record)

    def flush(self) -> None:
        """Wait until all lines are written, but not long, because their reader may have stopped."""
        written = threading.Event()
        self._queue.put(written)
        written.wait(_PATIENCE)

    def _write(self) -> None:
        """Write the lines of the queue, for ever."""
        while True:
            entries = [self._queue.get()]
            sleep(_PAUSE)
            count = min(self._queue.qsize(), _TOGETHER)
            entries += [self._queue.get() for _ in range(count)]
            lines = [entry for entry in entries if isinstance(entry, str)]
            if lost := self._lost - self._stated:
                self._stated += lost
                lines.append(self._statement(lost))
            with suppress(OSError):  # the reader has closed the pipe
                self._write_whole("".join(f"{line}\n" for line in lines))
            for entry in entries:
                if isinstance(entry, threading.Event):
                    entry.set()

    def _statement(self, lost: int) -> str:
        message = f"{lost} log lines are lost, because standard error was not read in time"
        return self.format(
            logging.LogRecord("app.log", logging.WARNING, "", 0, message, None, None)
        )

    def _write_whole(self, text: str) -> None:
        # A file object would block the end of the process, because this thread holds its lock.
        rest = memoryview(text.encode(errors="backslashreplace"))
        while rest:
            rest = rest[os.write(self._file, rest) :]


def flush() -> None:
    """Write the waiting log lines, before a signal ends the process."""
    for handler in logging.getLogger().handlers:
        handler.flush()


def _is_useful(record: logging.LogRecord) -> bool:
    # uvicorn advises to install a WebSocket library. The service answers upgrades as plain HTTP.
    return not str(record.msg).startswith("No supported WebSocket library")


def log_config(settings: Settings) -> dict[str, Any]:
    """Return the log configuration of the service and uvicorn for `logging.config.dictConfig`.

    The access log of uvicorn is off, because it would contain raw paths. The service writes its own
    access log. The log level of libraries is at least `info`, because numba logs each step of a
    compilation at `debug`.
    """
    level, key = settings.log_level.upper(), settings.api_key
    formatter = {
        "()": Masked,
        "style": settings.log_format,
        "secrets": [key.get_secret_value()] if key else [],
    }
    libraries = max(logging.getLevelNamesMapping()[level], logging.INFO)
    return {
        "version": 1,
        "disable_existing_loggers": False,
        "formatters": {"masked": formatter},
        "handlers": {
            "stderr": {
                "()": Lines,
                "formatter": "masked",
                "filters": [_is_useful],
            }
        },
        "root": {"handlers": ["stderr"], "level": libraries},
        "loggers": {"app": {"level": level}, "uvicorn.access": {"level": "CRITICAL"}},
    }
