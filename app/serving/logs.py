"""Log records as JSON lines or plain text, on standard error; never a payload or key in either."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any, Literal

_MASK = "**********"


def _masked(line: str, secrets: Sequence[str]) -> str:
    for secret in secrets:
        line = line.replace(secret, _MASK)
    return line


class JSONFormatter(logging.Formatter):
    """One JSON object a line: time, level, process, logger, message and the fields of a request.

    A record's attribute ``entry`` holds these fields for a line of the access log, ``request_id``
    the id of the request that met a defect.

    Args:
        secrets: texts to mask wherever they turn up; a defect's own words may quote anything.
    """

    def __init__(self, secrets: Sequence[str] = ()) -> None:
        super().__init__()
        # As they stand in a JSON string.
        self.secrets = [json.dumps(secret)[1:-1] for secret in secrets]
        self._second, self._text = -1, ""

    def format(self, record: logging.LogRecord) -> str:
        """The record as a line."""
        second = int(record.created)
        if second != self._second:
            self._second = second
            self._text = datetime.fromtimestamp(second, UTC).isoformat().removesuffix("+00:00")
        entry: dict[str, Any] = {
            "time": f"{self._text}.{int(record.msecs):03d}+00:00",
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
        return _masked(json.dumps(entry), self.secrets)


class PlainFormatter(logging.Formatter):
    """Text for people, with secrets masked."""

    def __init__(self, secrets: Sequence[str] = ()) -> None:
        super().__init__("%(asctime)s %(levelname)-8s %(process)d %(name)s: %(message)s")
        self.secrets = secrets

    def format(self, record: logging.LogRecord) -> str:
        """The record as lines."""
        return _masked(super().format(record), self.secrets)


class NoHandshakes(logging.Filter):
    """Drops the server's lines on WebSocket handshakes, which repeat addresses as asked."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the record is written."""
        return not (record.name == "uvicorn.error" and '"WebSocket %s"' in str(record.msg))


def log_config(
    level: str, style: Literal["json", "plain"], secrets: Sequence[str] = ()
) -> dict[str, Any]:
    """A configuration for `logging.config.dictConfig`, covering the service and its server.

    The server's own access log is off: it repeats paths as they were asked, and the service writes
    a line of its own with the request id. Libraries tell nothing below `info`, for at `debug` the
    server would list the headers of WebSocket handshakes, keys among them.

    Args:
        level: of the service's own records.
        style: one JSON object a line, or text.
        secrets: texts to mask.
    """
    known = logging.getLevelNamesMapping()
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
                "filters": ["no handshakes"],
            },
        },
        "filters": {"no handshakes": {"()": NoHandshakes}},
        "root": {"handlers": ["stderr"], "level": max(known[level.upper()], logging.INFO)},
        "loggers": {
            "app": {"level": level.upper()},
            "uvicorn.access": {"level": "CRITICAL"},
            # Tells of every WebSocket that opens, is refused or closes.
            "websockets": {"level": "WARNING"},
        },
    }
