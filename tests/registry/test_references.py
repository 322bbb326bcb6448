"""Spelling and order of versions, and what a reference points at."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.registry import AliasTarget
from app.registry.references import is_version, resolve_reference, version_key
from tests.registry.small_artifacts import refused

VERSIONS = {"rooms": ("1.0.0", "1.9.0", "1.10.0"), "halls": ("0.1.0",)}
ALIASES = {
    "default": AliasTarget(name="rooms"),
    "stable": AliasTarget(name="rooms", version="1.9.0"),
    "gone": AliasTarget(name="rooms", version="7.0.0"),
    "lost": AliasTarget(name="attic"),
    "halls": AliasTarget(name="rooms", version="1.0.0"),
}


INVALID = [
    *("", "@1.0.0", "rooms@", "rooms@latest", "rooms@1.0.0@1.0.0", "rooms@1.0.0\n"),
    *("../rooms", "Rooms", "a" * 65, "<script>"),
]


def resolve(reference: str) -> tuple[str, str]:
    return resolve_reference(reference, ALIASES, lambda name: VERSIONS.get(name, ()))


@pytest.mark.parametrize(
    ("reference", "version"),
    [
        ("rooms", "1.10.0"),
        ("rooms@1.9.0", "1.9.0"),
        ("default", "1.10.0"),
        ("stable", "1.9.0"),
        ("halls", "1.0.0"),  # an alias goes before a model of its name
    ],
)
def test_resolves(reference: str, version: str) -> None:
    assert resolve(reference) == ("rooms", version)


@pytest.mark.parametrize(
    ("reference", "code"),
    [
        ("attic", "unknown_model"),
        ("attic@1.0.0", "unknown_model"),
        ("rooms@1.0.1", "unknown_version"),
        ("gone", "dangling_alias"),
        ("lost", "dangling_alias"),
        *((reference, "invalid_reference") for reference in INVALID),
    ],
)
def test_refuses(reference: str, code: str) -> None:
    with refused(code) as raised:
        resolve(reference)
    assert "script" not in str(raised.value), "a reason does not repeat an invalid reference"


parts = st.tuples(*[st.integers(0, 10**9 - 1)] * 3)


@given(parts, parts)
def test_versions_are_ordered_as_numbers(one: tuple[int, ...], other: tuple[int, ...]) -> None:
    first, second = (".".join(map(str, version)) for version in (one, other))
    assert is_version(first)
    assert (version_key(first) < version_key(second)) == (one < other)
