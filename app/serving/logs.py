"""Log formats: JSON lines or plain text, on standard error. Keys are masked in every line."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from typing import Any, Final, Literal

from pythonjsonlogger.core import RESERVED_ATTRS
from pythonjsonlogger.orjson import OrjsonFormatter

_MASK: Final = "**********"

# No format shows the thread or the program of a record, and each takes time to find out.
logging.logThreads = logging.logMultiprocessing = False


class _Lines(OrjsonFormatter):
    """One JSON object per line: time, level, process, logger, message and fields of the record."""

    def __init__(self) -> None:
        super().__init__(
            ("levelname", "process", "name", "message"),
            rename_fields={"levelname": "level", "name": "logger", "exc_info": "exception"},
            reserved_attrs=(*RESERVED_ATTRS, "color_message"),  # of uvicorn
            timestamp="time",
        )

    def process_log_record(self, log_data: dict[str, Any]) -> dict[str, Any]:
        log_data["level"] = log_data["level"].lower()
        return log_data


class Masked(logging.Formatter):
    """Mask the keys in every line of a format. An exception message may contain a key.

    Args:
        style: `json` for one JSON object per line, or `plain` for text.
        secrets: the keys.
    """

    def __init__(self, style: Literal["json", "plain"], secrets: Sequence[str] = ()) -> None:
        super().__init__()
        if style == "json":
            self._format = _Lines().format
            # In a JSON line, a secret has the escaped form of a JSON string.
            self._secrets = [json.dumps(secret)[1:-1] for secret in secrets]
        else:
            layout = "%(asctime)s %(levelname)-8s %(process)d %(name)s: %(message)s"
            self._format = logging.Formatter(layout).format
            self._secrets = list(secrets)

    def format(self, record: logging.LogRecord) -> str:
        """Return the log record as text, with the keys masked."""
        text = self._format(record)
        for secret in self._secrets:
            text = text.replace(secret, _MASK)
        return text


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
    level = level.upper()
    libraries = max(logging.getLevelNamesMapping()[level], logging.INFO)
    return {
        "version": 1,
        "disable_existing_loggers": False,
        "formatters": {"masked": {"()": Masked, "style": style, "secrets": secrets}},
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
