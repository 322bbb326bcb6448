"""Keys that an HTTP header cannot carry. A client refuses them without the key in its message."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from scene_client import AsyncClient, Client, InvalidRequestError
from scene_client.command import app
from tests.conftest import run_program

KEYS = ["secret-key\n", "secret-\rkey", "sécret-key", "secret key", "secret\x7f", "secret\udcff"]
each_key = pytest.mark.parametrize("key", KEYS)
MESSAGE = "a key must have only ASCII characters, without spaces or line breaks"


@each_key
@pytest.mark.parametrize("argument", ["api_key", "admin_key"])
@pytest.mark.parametrize("kind", [Client, AsyncClient])
def test_an_argument_is_refused(kind: type[Client], argument: str, key: str) -> None:
    with pytest.raises(InvalidRequestError, match="ASCII") as raised:
        kind("http://robot", **{argument: key})
    assert str(raised.value) == MESSAGE


@each_key
def test_the_command_refuses_its_environment(monkeypatch: pytest.MonkeyPatch, key: str) -> None:
    monkeypatch.setenv("SCENE_API_KEY", key)
    result = CliRunner().invoke(app, ["missing", "bed"])
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr == MESSAGE + "\n"


def test_a_bridge_refuses_its_environment(repository: Path) -> None:
    program = (sys.executable, repository / "clients/ros2/over_rosbridge.py", "ws://robot", "/x")
    done = run_program(*program, env=os.environ | {"SCENE_API_KEY": KEYS[0]}, status=2)
    assert done.stderr.endswith(f"error: {MESSAGE}\n")
    assert "cret" not in done.stderr
