"""The file of a home: kill and resume, damage, versions, and full disks."""

import json
import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from scene_client import Home, HomeFileError
from tests.client.homes import FakeClient, thing
from tests.conftest import REPOSITORY, run_program

VIEW = (math.radians(90), 5.0)
POSE = (0.0, 0.0, 0.0)
SEEN = [thing("stove", 2.0), thing("fridge", 3.0, 1.0), thing("toilet", 3.0, -1.0)]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "home.json"


def home(file: Path | None) -> Home:
    client = FakeClient()
    client.odd = {"toilet"}
    return Home(client, view=VIEW, path=file)


def run(one: Home, seconds: range) -> list[str]:
    events = [e for now in seconds for e in one.update(SEEN, POSE, float(now), room="kitchen")]
    return [event.kind for event in events]


def test_it_resumes_with_all_it_knows(file):
    with home(file) as one:
        assert "out-of-place" in run(one, range(20))
        one.confirm(next(t.id for t in one.things() if t.label == "stove"))
        alarms, things = one.alarms, one.things()
    again = home(file)
    assert [(a.kind, a.id, a.since) for a in again.alarms] == [
        (a.kind, a.id, a.since) for a in alarms
    ]
    assert again.things() == things
    assert again.confirmed == {("stove", "kitchen")}
    assert again.coverage("kitchen") == one.coverage("kitchen")
    assert run(again, range(20, 40)) == []  # no event comes twice
    again.close()


def test_it_is_saved_every_ten_seconds_of_the_stamps(file):
    one = home(file)
    times = []
    for now in range(35):
        one.update(SEEN, POSE, float(now))
        times.append(json.loads(file.read_text())["stamp"])
    assert sorted(set(times)) == [0.0, 10.0, 20.0, 30.0]
    assert [path.name for path in file.parent.iterdir()] == ["home.json"]
    one.close()
    assert json.loads(file.read_text())["stamp"] == 34.0


def test_a_habit_is_saved_at_once(file):
    """No further frame comes, and the program has no chance to close the home."""
    one = home(file)
    run(one, range(5))
    one.confirm(one.things()[0].id)
    assert json.loads(file.read_text())["habits"] == [[one.things()[0].label, "kitchen"]]
    one.close()


PROGRAM = """
import sys
from tests.client.test_home_file import home, run
from pathlib import Path
one = home(Path(sys.argv[1]))
run(one, range(25))
{end}
"""


def program(end: str) -> list[str]:
    return [sys.executable, "-c", PROGRAM.format(end=end)]


def test_a_killed_program_resumes(file):
    command = [*program("print('ready', flush=True); sys.stdin.read()"), str(file)]
    paths = os.pathsep.join([str(REPOSITORY), str(REPOSITORY / "clients" / "python")])
    environment = os.environ | {"PYTHONPATH": paths}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, cwd=REPOSITORY, env=environment, **pipes) as process:
        assert process.stdout.readline() == b"ready\n"
        process.send_signal(signal.SIGKILL)
    one = home(file)
    assert [alarm.label for alarm in one.alarms] == ["toilet"]
    assert run(one, range(26, 46)) == []
    one.close()


def test_the_end_of_a_program_saves(file):
    paths = os.pathsep.join([str(REPOSITORY), str(REPOSITORY / "clients" / "python")])
    run_program(*program(""), str(file), env=os.environ | {"PYTHONPATH": paths})
    assert json.loads(file.read_text())["stamp"] == 24.0


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: b"",
        lambda text: text[: len(text) // 2],
        lambda text: text.replace(b'"log_odds"', b'"odds"'),
        lambda text: text.replace(b'"scene-home"', b'"other"'),
        lambda text: b"[1, 2]",
        lambda text: b"\xff\xfe",
        lambda text: text.replace(b'"version":1', b'"version":"1"'),
    ],
)
def test_a_damaged_file_is_an_error_and_stays(file, damage):
    with home(file) as one:
        run(one, range(5))
    file.write_bytes(damage(file.read_bytes()))
    before = file.read_bytes()
    with pytest.raises(HomeFileError, match="is not a whole file of a home"):
        home(file)
    assert file.read_bytes() == before


def test_a_newer_file_is_an_error_and_stays(file):
    file.write_text('{"version": 2, "format": "scene-home", "new": true}')
    with pytest.raises(HomeFileError, match="version 2, but this client reads up to version 1"):
        home(file)
    assert json.loads(file.read_text())["new"]


def test_an_error_of_the_disk_is_a_warning(tmp_path, caplog):
    one = home(tmp_path / "missing" / "home.json")
    assert "appeared" in run(one, range(5))
    assert "cannot save the home" in caplog.text
    with pytest.raises(OSError, match="missing"):
        one.save()
    one.save(tmp_path / "other.json")
    assert (tmp_path / "other.json").exists()
    one.close()
    with pytest.raises(ValueError, match="name a path"):
        home(None).save()
