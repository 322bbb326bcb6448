"""What tests of answers share."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module

import pytest


@pytest.fixture(scope="module")
def the_likeliest_is_expected() -> Iterator[None]:
    """However unlikely: small machines are sure of little."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(import_module("app.questions.relations"), "EXPECTED", 0)
        yield
