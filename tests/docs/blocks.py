"""Fenced blocks of Markdown pages: what each is, and what its reader would see.

A comment right above a fence says how to take it:

    <!-- not run: why -->     shown, not executed
    <!-- keeps running -->    the service itself, which is running while the page is executed

A `json` or `text` block right below an executed one is its output. There `...` stands for whatever
differs from call to call or would only be long: any characters of a text; in JSON any value, as the
last entry of a list any further entries, as a member (`"...": "..."`) any further members.
An answer's `request_id` may be left out.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markdown_it import MarkdownIt

EXECUTED = {"sh", "bash", "python"}
ELISION = "..."
_MARK = re.compile(r"<!-- (not run|keeps running)(?:: (.+?))? -->", re.DOTALL)


@dataclass(frozen=True)
class Block:
    """A fenced block.

    Attributes:
        page, line: where it stands; the line is that of its first line of text.
        language: the first word after the fence, empty where there is none.
        mark, reason: of the comment above it, empty where there is none.
        output: the block right below an executed one; None where there is none.
    """

    page: Path
    line: int
    language: str
    source: str
    mark: str = ""
    reason: str = ""
    output: Block | None = None

    def __str__(self) -> str:
        return f"{self.page.name}:{self.line}"


def blocks(page: Path) -> Iterator[Block]:
    """The blocks of a page in order; outputs within the blocks that they belong to."""
    found: list[Block] = []
    mark, before = None, None
    for token in MarkdownIt().parse(page.read_text(encoding="utf-8")):
        if token.type == "html_block" and (match := _MARK.fullmatch(token.content.strip())):
            mark, before = match, None
        elif token.type == "fence":
            assert token.map is not None
            block = Block(
                page=page,
                line=token.map[0] + 2,
                language=(token.info.split() or [""])[0],
                source=token.content,
                mark=mark[1] if mark else "",
                reason=" ".join((mark[2] or "").split()) if mark else "",
            )
            if before is not None and mark is None and block.language in {"json", "text"}:
                found[-1] = Block(**{**vars(before), "output": block})
                before = None
            else:
                found.append(block)
                before = block if block.language in EXECUTED and not block.mark else None
            mark = None
        else:
            mark = before = None
    yield from found


def agrees(expected: Any, actual: Any) -> bool:
    """Whether an answer is the printed one, but for elisions and the last digits of floats."""
    if expected == ELISION:
        return True
    if isinstance(expected, float) and isinstance(actual, float):
        # They differ between processors.
        return abs(expected - actual) <= 1e-4 * max(1.0, abs(expected))
    if isinstance(expected, dict) and isinstance(actual, dict):
        expected, actual = dict(expected), dict(actual)
        if "request_id" not in expected:
            actual.pop("request_id", None)
        open_ended = expected.pop(ELISION, None) is not None
        if not (
            expected.keys() <= actual.keys() if open_ended else expected.keys() == actual.keys()
        ):
            return False
        return all(agrees(value, actual[name]) for name, value in expected.items())
    if isinstance(expected, list) and isinstance(actual, list):
        if expected and expected[-1] == ELISION:
            expected, actual = expected[:-1], actual[: len(expected) - 1]
        return len(expected) == len(actual) and all(map(agrees, expected, actual))
    return bool(expected == actual)


def text_agrees(expected: str, actual: str) -> bool:
    """The same of a text; blanks at the ends of lines do not count."""
    lines = "\n".join(line.rstrip() for line in expected.strip().splitlines())
    found = "\n".join(line.rstrip() for line in actual.strip().splitlines())
    pattern = ".*?".join(re.escape(part) for part in lines.split(ELISION))
    return re.fullmatch(pattern, found, re.DOTALL) is not None


def check_output(block: Block, printed: str) -> None:
    """Compare what a block printed with the block below it.

    Raises:
        AssertionError: it printed something else.
    """
    if block.output is None:
        return
    expected = block.output.source
    if block.output.language == "json":
        assert agrees(json.loads(expected), json.loads(printed)), f"{block} answers {printed}"
    else:
        assert text_agrees(expected, printed), f"{block} prints\n{printed}"
