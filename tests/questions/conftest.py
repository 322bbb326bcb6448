"""Fixtures for tests of the questions."""

from collections.abc import Iterator

import pytest

from tests.questions import answers


@pytest.fixture(scope="module")
def without_minimums() -> Iterator[None]:
    """Answers list weak entries too, because small machines give few strong ones."""
    with answers.without_minimums():
        yield
