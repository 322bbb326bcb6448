"""Log formats: JSON lines or plain text, on standard error. Keys are masked in every line."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from datetime import UTC, datetime
from functools import lru_cache
from typing import Any, Literal

import orjson

_MASK = "**********"


# No format shows the thread or the program of a record, and each takes time to find out.
logging.logThreads = logging.logMultiprocessing = False


@lru_cache(maxsize=2)
def _utc(second: int) -> str:
    """Return the time of a Unix time in seconds in the form of ISO 8601, without a time zone."""
    return datetime.fromtimestamp(second, UTC).replace(tzinfo=None).isoformat()


def _masked(line: str, secrets: Sequence[str]) -> str:
    for secret in secrets:
        line = line.replace(secret, _MASK)
    return line


class JSONFormatter(logging.Formatter):
    """Write one JSON object per line: time, level, process, logger, message and request fields.

    Two optional attributes of a log record add fields to the JSON object. The attribute ``entry``
    contains the fields of an access log line. The attribute ``request_id`` is the id of the request
    that caused an internal error.

    Args:
        secrets: keys to mask in every line. An exception message may contain a key.
    """

    def __init__(self, secrets: Sequence[str] = ()) -> None:
        super().__init__()
        # In a JSON line, a secret has the escaped form of a JSON string.
        self.secrets = [json.dumps(secret)[1:-1] for secret in secrets]

    def format(self, record: logging.LogRecord) -> str:
        """Return the log record as one line of JSON."""
        second, milliseconds = divmod(int(record.created * 1e3), 1000)
        entry: dict[str, Any] = {
            "time": f"{_utc(second)}.{milliseconds:03}+00:00",
            "level": record.levelname.lower(),
            "process": record.process,
            "logger": record.name,
            "message": record.getMessage(),
        }
        if hasattr(record, "request_id"):
            entry["request_id"] = record.request_id
        entry |= getattr(record, "entry", {})
        if record.exc_info:
            entry["exception"] = self.formatException(record.exc_info)
        try:
            line = orjson.dumps(entry).decode()
        except TypeError:  # a text that is not valid Unicode
            line = json.dumps(entry)
        return _masked(line, self.secrets)


class PlainFormatter(logging.Formatter):
    """Write records as plain text, with secrets masked."""

    def __init__(self, secrets: Sequence[str] = ()) -> None:
        super().__init__("%(asctime)s %(levelname)-8s %(process)d %(name)s: %(message)s")
        self.secrets = secrets

    def format(self, record: logging.LogRecord) -> str:
        """Return the log record as one or several lines of text."""
        return _masked(super().format(record), self.secrets)


def _is_useful(record: logging.LogRecord) -> bool:
    """Return False for uvicorn's advice to install a WebSocket library.

    The service answers each upgrade request as plain HTTP.
    """
    return not str(record.msg).startswith("No supported WebSocket library")


def log_config(
    level: str, style: Literal["json", "plain"], secrets: Sequence[str] = ()
) -> dict[str, Any]:
    """Return the log configuration of the service and uvicorn for `logging.config.dictConfig`.

    The access log of uvicorn is off, because it would contain raw paths. The service writes its own
    access log. The log level of libraries is at least `info`, because at `debug` numba would log
    each step of a compilation. Every line masks the secrets.
    """
    levels = logging.getLevelNamesMapping()
    return {
        "version": 1,
        "disable_existing_loggers": False,
        "formatters": {
            "json": {"()": JSONFormatter, "secrets": secrets},
            "plain": {"()": PlainFormatter, "secrets": secrets},
        },
        "handlers": {
            "stderr": {
                "class": "logging.StreamHandler",
                "formatter": style,
                "filters": [_is_useful],
            }
        },
        "root": {"handlers": ["stderr"], "level": max(levels[level.upper()], logging.INFO)},
        "loggers": {"app": {"level": level.upper()}, "uvicorn.access": {"level": "CRITICAL"}},
    }
