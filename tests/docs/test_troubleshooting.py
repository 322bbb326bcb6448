"""The messages and problem types of the page on troubleshooting are those of the service."""

import ast
import re

import pytest

from app.errors import ERRORS
from tests.conftest import REPOSITORY

PAGE = (REPOSITORY / "docs" / "troubleshooting.md").read_text("utf-8")
SYMPTOMS = re.findall(r"^\| `([^`]+)` \|", PAGE, re.MULTILINE)


@pytest.fixture(scope="module")
def messages() -> str:
    """The string constants of the service and the client, f-strings in pieces."""
    sources = [*REPOSITORY.glob("app/**/*.py"), *REPOSITORY.glob("clients/python/**/*.py")]
    return "\n".join(
        node.value
        for path in sources
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    )


@pytest.mark.parametrize("symptom", SYMPTOMS)
def test_a_symptom_is_a_problem_or_a_message(symptom: str, messages: str) -> None:
    if match := re.fullmatch(r"(\d{3}) ([a-z-]+)", symptom):
        assert ERRORS[match[2]].status == int(match[1])
    else:
        assert symptom in messages


def test_the_page_has_symptoms() -> None:
    assert len(SYMPTOMS) > 20
