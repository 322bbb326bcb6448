"""Log formats: JSON lines or plain text, on standard error. Keys are masked in every line."""

import json
import logging
from collections.abc import Sequence
from datetime import UTC, datetime
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
                "class": "logging.StreamHandler",
                "formatter": "masked",
                "filters": [_is_useful],
            }
        },
        "root": {"handlers": ["stderr"], "level": libraries},
        "loggers": {"app": {"level": level}, "uvicorn.access": {"level": "CRITICAL"}},
    }
