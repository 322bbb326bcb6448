"""Log records as JSON lines or plain text, on standard error; never a payload in either."""

from __future__ import annotations

import json
import logging
from datetime import UTC, datetime
from typing import Any, Literal

_EXTRAS = (
    "request_id",
    "method",
    "route",
    "status",
    "outcome",
    "model",
    "version",
    "latency_ms",
    "queue_ms",
    "compute_ms",
)


class JSONFormatter(logging.Formatter):
    """One JSON object a line: time, level, process, logger, message, what the request was."""

    def format(self, record: logging.LogRecord) -> str:
        """The record as a line."""
        entry: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "process": record.process,
            "logger": record.name,
            "message": record.getMessage(),
        }
        entry |= {name: getattr(record, name) for name in _EXTRAS if hasattr(record, name)}
        if record.exc_info:
            entry["exception"] = self.formatException(record.exc_info)
        return json.dumps(entry)


def log_config(level: str, style: Literal["json", "plain"]) -> dict[str, Any]:
    """A configuration for `logging.config.dictConfig`, covering the service and its server.

    The server's own access log is off: it repeats paths as they were asked, and the service writes
    a line of its own with the request id.
    """
    return {
        "version": 1,
        "disable_existing_loggers": False,
        "formatters": {
            "json": {"()": JSONFormatter},
            "plain": {"format": "%(asctime)s %(levelname)-8s %(process)d %(name)s: %(message)s"},
        },
        "handlers": {
            "stderr": {"class": "logging.StreamHandler", "formatter": style},
        },
        "root": {"handlers": ["stderr"], "level": level.upper()},
        "loggers": {"uvicorn.access": {"level": "CRITICAL"}},
    }
