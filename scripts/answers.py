"""The README's questions, asked of the shipped models: `python -m scripts.answers` fills them in.

Every `sh` block that calls curl is followed by a `json` block with the answer as the service gives
it; `request_id`, which differs from call to call, is left out. tests/shipped holds the README to
it.
"""

from __future__ import annotations

import asyncio
import json
import re
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
from fastapi import FastAPI

from app.main import create_app

README = Path(__file__).resolve().parent.parent / "README.md"
_PAIR = re.compile(r"```sh\n(curl .*?)```\n\n```json\n(.*?)```", re.DOTALL)


@dataclass(frozen=True)
class Example:
    """One question of the README and the answer printed below it."""

    path: str
    body: dict[str, Any]
    answer: str


def examples(text: str) -> Iterator[Example]:
    """The questions of a Markdown text, in order."""
    for match in _PAIR.finditer(text):
        words = shlex.split(match[1].replace("\\\n", " "))
        url = next(word for word in words if word.startswith("http"))
        body = json.loads(words[words.index("-d") + 1])
        yield Example("/" + url.split("/", 3)[3], body, match[2])


async def ask_all(app: FastAPI, asked: Sequence[Example]) -> list[dict[str, Any]]:
    """The service's answers, in process, without their request ids."""
    transport = httpx.ASGITransport(app)
    answers = []
    async with (
        app.router.lifespan_context(app),
        httpx.AsyncClient(transport=transport, base_url="http://robot") as client,
    ):
        for example in asked:
            response = await client.post(example.path, json=example.body)
            response.raise_for_status()
            answer: dict[str, Any] = response.json()
            del answer["request_id"]
            answers.append(answer)
    return answers


def pretty(answer: dict[str, Any]) -> str:
    """JSON with one entry of a list a line, so that an answer reads as a table."""
    lines = []
    for name, value in answer.items():
        if isinstance(value, list) and value:
            entries = ",\n  ".join(json.dumps(entry, ensure_ascii=False) for entry in value)
            lines.append(f'"{name}": [\n  {entries}]')
        else:
            lines.append(f'"{name}": {json.dumps(value, ensure_ascii=False)}')
    return "{" + ",\n ".join(lines) + "}\n"


def main() -> None:
    """Rewrite the answers of the README in place."""
    text = README.read_text(encoding="utf-8")
    answers = iter(asyncio.run(ask_all(create_app(), list(examples(text)))))

    def fill(match: re.Match[str]) -> str:
        return f"```sh\n{match[1]}```\n\n```json\n{pretty(next(answers))}```"

    README.write_text(_PAIR.sub(fill, text), encoding="utf-8")


if __name__ == "__main__":
    main()
