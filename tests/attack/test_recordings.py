"""Hostile or damaged files of a robot: its recording, and the file of its home."""

import json
import logging
import os
from collections.abc import Callable, Iterator
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import pytest

from scene_client import Client, HomeFileError, home_state, recorder, schemas
from scene_client.recorded_scene import scene_of
from scene_client.recorder import Recorder
from tests.client.homes import FakeClient
from tests.client.test_home_file import SEEN, home, run
from tests.client.test_recorder import labels, lines, request, write
from training.datasets.jsonl import MAX_LINE

SCENE = json.dumps(scene_of(request("bed", "lamp"))).encode()
DEEP = b"[" * 100_000
TAILS = {
    "deep list": DEEP,
    "deep object": b'{"objects":' * 100_000,
    "deep scene": b'{"objects": ' + DEEP,
    "whole deep scene": b'{"objects": ' + DEEP + b"]" * 100_000 + b"}",
    "part of a scene": SCENE[:-9],
    "long number": b'{"objects": [' + b"9" * 10_000,
    "no text": b"\xff\xfe\0\0",
    "zeros of a lost block": bytes(5000),
    "long line": b" " * MAX_LINE,
}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "scenes.jsonl"


def damaged(file: Path) -> Path:
    return file.with_name("scenes.jsonl.damaged")


@pytest.mark.parametrize("name", TAILS)
def test_an_unreadable_end_is_set_aside(
    name: str, file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file.write_bytes(SCENE + b"\n" + TAILS[name])
    write(file, [request("desk", "lamp")])
    assert labels(file) == [["bed", "lamp"], ["desk", "lamp"]]
    assert damaged(file).read_bytes() == TAILS[name] + b"\n"
    (warning,) = (one for one in caplog.records if one.name == recorder.__name__)
    assert warning.levelno == logging.WARNING
    assert f"its {len(TAILS[name])} bytes are in scenes.jsonl.damaged now" in warning.getMessage()


@pytest.mark.parametrize("name", TAILS)
def test_a_client_starts_beside_unreadable_lines(name: str, file: Path) -> None:
    hostile = [b'{"group": [], "objects": [{"label": {}}, 5]}', b"[]", b"5", b'"a"', b"null", b"{}"]
    file.write_bytes(b"\n".join([SCENE, *hostile, TAILS[name], SCENE, b""]))
    before = file.read_bytes()
    Client("http://127.0.0.1:9", record=file).close()
    write(file, [request("bed", "lamp")])  # it is in the file
    assert file.read_bytes() == before
    assert not damaged(file).exists()


def test_a_readable_end_stays(file: Path) -> None:
    last = json.dumps(scene_of(request("bed", "sofa"))).encode()
    file.write_bytes(SCENE + b"\n" + last)
    write(file, [request("desk", "lamp")])
    assert len(lines(file)) == 3
    assert not damaged(file).exists()


def test_the_damaged_lines_have_a_limit(file: Path) -> None:
    sizes = []
    for n in range(6):
        with file.open("ab") as stream:
            stream.write(b"{" * 1000)
        write(Recorder(file, most_bytes=2000), [request("desk", f"lamp {n}")])
        sizes.append(damaged(file).stat().st_size)
    assert sizes == [1001, 2002, 1001, 2002, 1001, 2002]


def test_damaged_lines_that_cannot_be_written_stay(
    file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file.write_bytes(SCENE + b"\n{")
    damaged(file).mkdir()
    write(file, [request("desk", "lamp")])
    assert file.read_bytes() == SCENE + b"\n{"
    assert "cannot record scenes" in caplog.text


# ------------------------------------------------------------------------------ file of a home


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "home.json"
    with home(path) as one:
        run(one, range(30))
    return path


def as_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.write_bytes(DEEP),
        lambda path: path.write_bytes(b'{"version": 1, "rooms": ' + DEEP),
        lambda path: path.write_bytes(b'{"version": 1, "count": ' + b"9" * 10_000 + b"}"),
        lambda path: path.write_bytes(b"[" + b"[]," * home_state.MOST_BYTES + b"[]]"),
        lambda path: os.truncate(path, 2**40),
        as_pipe,
    ],
    ids=["deep", "deep rooms", "long number", "many values", "terabyte", "pipe"],
)
def test_a_hostile_file_of_a_home_is_an_error(saved: Path, damage: Callable[[Path], None]) -> None:
    damage(saved)
    with pytest.raises(HomeFileError) as refused:
        home(saved)
    assert str(refused.value).startswith(f"{saved} is not a whole file of a home (")
    assert len(str(refused.value).removeprefix(str(saved))) < 300
    assert "\n" not in str(refused.value)


MARK = "@value@"
VALUES = (
    *("NaN", "Infinity", "1e308", "-1e308", "1e999", "-1", "0", "1" + "0" * 300, "null", "true"),
    *('""', '"' + "x" * 300 + '"', r'"\u001b[31m\n"', '"lamp"', "[]", "{}"),
)


def leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    yield path
    entries = dict(enumerate(value)) if isinstance(value, list) else value
    for key, part in entries.items() if isinstance(entries, dict) else ():
        yield from leaves(part, (*path, key))


def places(saved: Path) -> list[tuple[Any, ...]]:
    state = json.loads(saved.read_bytes())
    state["tracks"] = {"t1": state["tracks"]["t1"]}
    saved.write_text(json.dumps(state))
    return [path for path in leaves(state) if path]


def test_every_value_of_a_home_is_refused_or_does_no_harm(saved: Path) -> None:
    paths, text, refusals = places(saved), saved.read_text(), 0
    assert len(paths) > 40
    for *outer, last in paths:
        for value in VALUES:
            state = json.loads(text)
            reduce(getitem, outer, state)[last] = MARK
            saved.write_text(json.dumps(state).replace(f'"{MARK}"', value))
            try:
                one = home(saved)
            except HomeFileError:
                refusals += 1
                continue
            one.path = None  # `close` must not write it
            # A new frame, and requests as the service would accept them.
            one.update(SEEN, (0.0, 0.0, 0.0), 31.0, room="kitchen")
            schemas.SceneRequest.model_validate(one.scene())
            assert isinstance(one.client, FakeClient)
            one.where("lamp")
            one.save(saved)
            home(saved).path = None
    assert len(VALUES) * len(paths) * 0.7 < refusals < len(VALUES) * len(paths)


def test_a_home_writes_no_file_that_it_refuses(
    saved: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    before, one = saved.read_bytes(), home(saved)
    monkeypatch.setattr(home_state, "MOST_BYTES", len(before) // 2)
    one.close()
    assert "cannot save the home" in caplog.text
    assert saved.read_bytes() == before
