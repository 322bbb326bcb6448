"""The tables of messages in the documentation list the messages and problems of the service. A
problem of a request also has a page of the service: `test_every_problem_type_has_a_page` in
tests/http/test_problems.py."""

import ast
import re

import pytest

from app.errors import ERRORS
from tests.conftest import REPOSITORY

TABLE = re.compile(r"^\| Message \|.+\n\|[-|]+\n((?:\|.+\n)+)", re.MULTILINE)
LISTED = [
    (page.name, message)
    for page in sorted((REPOSITORY / "docs").glob("*.md"))
    for table in TABLE.findall(page.read_text("utf-8"))
    for message in re.findall(r"^\| `([^`]+)` \|", table, re.MULTILINE)
]
EXPLAINED = {
    "operations.md": (
        # errors and warnings of the start
        *("unknown setting", "SCENE_STORE must be", "another program uses"),
        *("compiling loops", "other users can write to", "no cache directory is usable"),
        # refused models
        *("503 not-ready", "this release reads format", "does not have format"),
        *("answers instead", "does not match its checksum"),
        *("already published with the digest", "holds the lock of the store"),
    ),
    "network.md": ("cannot be reached", "401 unauthorized", "421 host-refused"),
}
"""The messages that each page must explain, because no page of the service does."""


@pytest.fixture(scope="module")
def messages() -> str:
    sources = [*REPOSITORY.glob("app/**/*.py"), *REPOSITORY.glob("clients/python/**/*.py")]
    return "\n".join(
        node.value
        for path in sources
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    )


@pytest.mark.parametrize(("page", "message"), LISTED)
def test_a_listed_message_is_a_problem_or_a_text_of_the_service(page, message, messages):
    if match := re.fullmatch(r"(\d{3}) ([a-z-]+)", message):
        assert ERRORS[match[2]].status == int(match[1]), page
    else:
        assert message in messages, page


@pytest.mark.parametrize("page", EXPLAINED)
def test_a_page_explains_the_messages_of_its_subject(page: str) -> None:
    listed = [message for name, message in LISTED if name == page]
    for message in EXPLAINED[page]:
        assert any(message in entry for entry in listed), message
