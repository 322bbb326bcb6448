"""The conversation of docs/stream.md, had with the shipped default model."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from app.api.stream import LEAST_COST, READING_BURST, READING_SHARE
from app.settings import Settings
from scene_client.stream_messages import COMMANDS, EVENTS, AnswerMessage
from tests.http.streams import hear, opened
from tests.services import LiveService

pytestmark = pytest.mark.system

REPOSITORY = Path(__file__).resolve().parents[2]
DOCUMENT = (REPOSITORY / "docs" / "stream.md").read_text("utf-8")


def conversation() -> Iterator[tuple[str, dict[str, Any]]]:
    """Who says what, message by message."""
    for block in re.findall(r"^```text\n(.*?)^```", DOCUMENT, re.MULTILINE | re.DOTALL):
        for who, text in re.findall(r"^([→←]) (.*?)(?=^[→←]|\Z)", block, re.MULTILINE | re.DOTALL):
            yield who, json.loads(text)


def shows(written: Any, real: Any, place: str = "") -> None:
    """Whatever is written is so; floats but for their last digits."""
    if isinstance(written, dict):
        for name, value in written.items():
            shows(value, real[name], f"{place}/{name}")
    elif isinstance(written, list):
        assert len(written) == len(real), place
        for number, (one, other) in enumerate(zip(written, real, strict=True)):
            shows(one, other, f"{place}/{number}")
    elif isinstance(written, float):
        assert real == pytest.approx(written, rel=1e-3), place
    else:
        assert written == real, place


def test_the_service_says_what_the_document_says(shipped: LiveService) -> None:
    with opened(shipped) as stream:
        for who, message in conversation():
            if who == "→":
                stream.send(json.dumps(message))
            else:
                shows(message, hear(stream))


def test_every_message_and_setting_is_in_the_document() -> None:
    said = list(conversation())
    assert {message["type"] for who, message in said if who == "←"} == set(EVENTS)
    for kind in COMMANDS:
        assert f"| `{kind}` |" in DOCUMENT
    for name in AnswerMessage.model_fields:
        assert f"`{name}`" in DOCUMENT
    for name in ("max_streams", "stream_idle"):
        default = f"{Settings.model_fields[name].default:g}"
        assert f"| `SCENE_{name.upper()}` | {default} |" in DOCUMENT
    assert f"{100 * READING_SHARE:g} % of a core, with a burst of {READING_BURST:g} s" in DOCUMENT
    assert f"at least {1e3 * LEAST_COST:g} ms" in DOCUMENT
    assert f"{READING_SHARE / LEAST_COST:g} small messages a second" in DOCUMENT
