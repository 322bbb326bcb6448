"""The file of recorded scenes: its scenes, and crashes and full disks."""

import json
import logging
import os
import stat
import sys
import threading
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from app.questions.reading import Limits, read_scene
from app.scene import CANONICAL
from scene_client import Client, OfflineClient, ProblemError, Recorder, recorder
from scene_client.command import app
from scene_client.recorded_scene import scene_of
from scene_client.schemas import MissingRequest
from tests.client.callers import async_caller, sync_caller
from tests.conftest import run_program
from tests.http.stores import VOCABULARY
from tests.services import PATIENCE
from training.datasets.encoding import encode
from training.datasets.jsonl import read_jsonl

QUESTIONS = ("missing", "outliers", "relations", "rooms")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "scenes.jsonl"


def request(*objects: Any, **fields: Any) -> MissingRequest:
    return MissingRequest.model_validate({"objects": list(objects), **fields})


def write(writer: Recorder | Path, requests: list[MissingRequest]) -> None:
    """Record requests with a recorder, or with a new one for a file."""
    writer = Recorder(writer) if isinstance(writer, Path) else writer
    writer.record(requests)
    writer.flush()


def box(label: str, x: float, y: float, z: float, **more: Any) -> dict[str, Any]:
    position, size = {"x": x, "y": y, "z": z}, {"x": 0.4, "y": 0.6, "z": 0.5}
    return {"id": label, "label": label, "position": position, "size": size, **more}


def lines(file: Path) -> list[dict[str, Any]]:
    """The scenes of a file; every line must be readable for the training."""
    scenes = [json.loads(line) for line in file.read_bytes().splitlines()]
    assert [scene.scene_id for scene in read_jsonl(file)] == [one["scene_id"] for one in scenes]
    return scenes


def labels(file: Path) -> list[list[str]]:
    return [[thing["label"] for thing in scene["objects"]] for scene in lines(file)]


OFFLINE = partial(sync_caller, kind=OfflineClient)


@pytest.mark.parametrize("caller", [sync_caller, async_caller, OFFLINE])
def test_a_scene_is_recorded_once(url: str, shared_store: Path, file: Path, caller: Any) -> None:
    with caller(shared_store if caller is OFFLINE else url, record=str(file)) as call:
        for question in QUESTIONS:
            call(question, ["bed", "lamp"])
    assert labels(file) == [["bed", "lamp"]]
    assert stat.S_IMODE(file.stat().st_mode) == 0o600


def test_only_answered_scenes_are_written(url: str, file: Path) -> None:
    with Client(url, record=file) as scene:
        scene.generate(["bed", "lamp"], steps=1)
        scene.missing(["bed"])
        with pytest.raises(ProblemError):
            scene.missing(["bed", "flux capacitor"])
        assert not file.exists()
        answer = scene.outliers_batch(
            [{"objects": ["bed", "desk"]}, {"objects": ["bed", "flux capacitor"]}, ["lamp", "desk"]]
        )
    assert [entry.status for entry in answer.results] == [200, 422, 200]
    assert labels(file) == [["bed", "desk"], ["lamp", "desk"]]


def test_new_evidence_is_written(file: Path) -> None:
    writer = Recorder(file)
    lamp, bed = {"id": "track_7", "label": "lamp"}, {"id": "track_9", "label": "bed"}
    on_top = [("track_7", "on-top", "track_9")]
    stated = [
        request("bed", "lamp"),
        request(lamp, bed),  # ids change from frame to frame
        request(lamp, bed, room_type="bedroom"),
        request(lamp, bed, relations=on_top),
        request(lamp, bed, relations=[("track_7", "left", "track_9")]),  # is not recorded
        request(lamp, bed, relations=on_top, room_type="bedroom"),
        request("bed", "lamp", "lamp"),
        request("bed", "lamp", stamp={"sec": 7200, "nanosec": 5}),
    ]
    for _ in range(3):
        write(writer, stated)
    assert [(one.get("room_type"), len(one["objects"])) for one in lines(file)] == [
        (None, 2), ("bedroom", 2), (None, 2), (None, 3), (None, 2)
    ]  # fmt: skip
    assert lines(file)[2]["objects"][0]["supported_by"] == "track_9"
    assert lines(file)[-1]["stamp"] == {"sec": 7200, "nanosec": 5}
    assert lines(file)[-1]["group"] == lines(file)[-1]["scene_id"][:13]


def test_moved_objects_wait_for_the_pause(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 1000.0
    monkeypatch.setattr(recorder, "monotonic", lambda: now)
    writer = Recorder(file)
    desk = box("desk", 2, 0, 0.25)

    def see(x: float) -> int:
        write(writer, [request(desk, box("lamp", x, 1.1, 0.25))])
        return len(lines(file))

    assert [see(1.2), see(1.3), see(2.8)] == [1, 1, 1]
    now += recorder.PAUSE
    assert [see(1.3), see(2.8)] == [1, 1]  # unchanged, then compared too early
    now += recorder.PAUSE
    assert [see(2.8), see(2.8), see(1.2)] == [2, 2, 2]


def test_another_run_repeats_no_scene(file: Path) -> None:
    stated = request("bed", {"label": "lamp", "supported_by": "bed"}, room_type="bedroom")
    complete = request("bed", "desk", relations=[("bed", "left", "desk")], relations_complete=True)
    write(file, [stated, complete])
    write(file, [complete, stated, request("bed", "desk", "lamp")])
    assert len(lines(file)) == 3


def test_improbable_objects_are_left_out(file: Path) -> None:
    faint = {"id": "cup", "label": "cup", "confidence": 0.49}
    lamp = {"id": "lamp", "label": "lamp", "confidence": 0.5, "supported_by": "cup"}
    write(file, [request("bed", faint, lamp, relations=[("cup", "on-top", "bed")])])
    (scene,) = lines(file)
    assert scene["objects"] == [{"id": "bed", "label": "bed"}, {"id": "lamp", "label": "lamp"}]


def test_relations_are_listed_only_if_all_are_stated() -> None:
    stated = [("lamp", "on-top", "desk"), ("bed", "left", "desk"), ("desk", "under", "chair_1")]
    things = ["lamp", "desk", "bed", "chair", {"label": "chair", "supported_by": "bed"}]
    partial = scene_of(request(*things, relations=stated))
    assert "relations" not in partial
    assert {one["id"]: one.get("supported_by") for one in partial["objects"]} == {
        "lamp": "desk", "desk": None, "bed": None, "chair_1": "desk", "chair_2": "bed"
    }  # fmt: skip
    complete = scene_of(request(*things, relations=stated, relations_complete=True))
    assert complete["relations"] == [*map(list, stated), ["chair_2", "on-top", "bed"]]


FRAMES = [
    {},
    {"frame_id": "base_link"},
    {"frame_id": "base_link", "viewpoint": {"x": 0.5, "y": -0.3, "yaw": 2.5}},
    {"frame_id": "camera_color_optical_frame"},
    {"frame_id": "map", "viewpoint": {"x": -1.0, "y": 0.7, "yaw": -1.2}},
]


@given(
    st.sampled_from(FRAMES),
    st.lists(st.tuples(*[st.integers(-20, 20)] * 3), min_size=3, max_size=3),
    st.sampled_from([{}, {"yaw": 0.7}, {"orientation": {"x": 0.0, "y": 0.0, "z": 0.6, "w": 0.8}}]),
)
def test_the_training_derives_the_relations_of_the_service(frame, places, turn):
    names = VOCABULARY.labels[:3]
    placed = zip(names, places, strict=True)
    boxes = [box(name, x / 10, y / 10, z / 10, **turn) for name, (x, y, z) in placed]
    asked = request(*boxes, **frame)
    observed = read_scene(asked, VOCABULARY, Limits()).observed or []
    with TemporaryDirectory() as folder:
        file = Path(folder, "scene.jsonl")
        file.write_text(json.dumps(scene_of(asked)))
        (annotated,) = read_jsonl(file)
    assert annotated.viewer_frame
    (scene,) = encode([annotated], VOCABULARY)
    assert {tuple(map(int, one)) for one in np.argwhere(scene.instance_holds)} == {
        (CANONICAL.index(one.relation), names.index(one.subject), names.index(one.object))
        for one in observed
    }


def test_declared_conventions_are_recorded_in_metres_with_z_up() -> None:
    bed = {"label": "bed", "position": [2, 1, 0.4], "size": [2, 1.6, 0.8], "yaw": 0.5}
    told = {"label": "bed", "position": [-100, 0, -200], "size": [80, 40, 100], "yaw": 0.5}
    view = {"x": 50.0, "y": -25.0, "yaw": 0.1}
    fields = {"up": "y", "units": "cm", "extents": "half", "box_origin": "bottom"}
    declared = scene_of(request(told, "lamp", viewpoint=view, **fields))
    view = {"x": 0.5, "y": -0.25, "yaw": 0.1}
    assert declared["objects"] == scene_of(request(bed, "lamp", viewpoint=view))["objects"]


def test_a_map_without_a_viewpoint() -> None:
    boxes = box("bed", 1, 2, 0.25), box("lamp", 3, 2, 0.25)
    scene = scene_of(request(*boxes, frame_id="robot/map"))
    assert scene["viewer_frame"] is False
    assert scene["objects"][0]["position"] == [1.0, 2.0, 0.25]
    assert "viewer_frame" not in scene_of(request("bed", "lamp", frame_id="map"))


# Each scene has a thousand bytes or more, so the operating system writes it in several pages.
SCENES = """
import itertools, os, random, resource, signal, sys, time
from scene_client import Recorder, recorder
from scene_client.schemas import MissingRequest

recorder._LONGEST_WAIT = 30.0  # a busy machine

def scene(name, objects=200):
    things = [{"id": f"{n}" + "x" * 90, "label": f"{name} {n} " + "y" * 60} for n in range(objects)]
    return MissingRequest.model_validate({"objects": things})
"""


def run(program: str, *arguments: object) -> str:
    """Run a program after `SCENES` and return its output and its log."""
    done = run_program(sys.executable, "-c", SCENES + program, *map(str, arguments))
    return done.stdout + done.stderr


def test_processes_and_threads_share_the_file(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder, "_LONGEST_WAIT", 30.0)
    writers = [
        threading.Thread(target=run, args=("""
for n in range(50):
    Recorder(sys.argv[1]).record([scene(f"{sys.argv[2]} {n}")])
""", file, name)) for name in "abc"
    ]  # fmt: skip
    own = Recorder(file)

    def ask(name: str) -> None:
        for n in range(50):
            own.record([request(f"{name} {n}", "lamp")])

    writers += [threading.Thread(target=ask, args=(name,)) for name in "de"]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    own.flush()
    first = [scene[0].split(" ")[:2] for scene in labels(file)]
    assert sorted(first) == sorted([name, str(n)] for name in "abcde" for n in range(50))


def test_a_forked_process_records_with_its_own_thread(file: Path) -> None:
    run("""
writer = Recorder(sys.argv[1])
writer.record([scene("parent")])
if not (child := os.fork()):
    writer.record([scene("child")])
    writer.flush()
    os._exit(0)
os.waitpid(child, 0)
writer.record([scene("later")])
""", file)  # fmt: skip
    assert sorted(scene[0].split()[0] for scene in labels(file)) == ["child", "later", "parent"]


def test_a_slow_disk_limits_the_waiting_scenes(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk, append = threading.Event(), Recorder._append

    def slow(self: Recorder, scenes: Any) -> None:
        disk.wait(PATIENCE)
        append(self, scenes)

    monkeypatch.setattr(Recorder, "_append", slow)
    writer = Recorder(file)
    writer.record([request("bed", f"thing {n}") for n in range(1, recorder.MOST_WAITING)])
    more = threading.Thread(target=writer.record, args=([request("bed", "lamp")],))
    more.start()
    more.join(0.2)
    assert more.is_alive()
    disk.set()
    more.join(PATIENCE)
    writer.flush()
    assert len(lines(file)) == recorder.MOST_WAITING


def test_a_killed_writer_leaves_whole_lines(file: Path) -> None:
    killed = run("""
torn, size = 0, lambda: os.path.exists(sys.argv[1]) and os.path.getsize(sys.argv[1])
for turn in range(60):
    before, child = size(), os.fork()
    if not child:
        writer = Recorder(sys.argv[1], most_bytes=2**40)
        for n in itertools.count():
            writer.record([scene(f"{turn} {n}", 50)])
    while size() <= before:  # the first line also mends the file
        time.sleep(0.001)
    time.sleep(random.uniform(0.0, 0.05))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    with open(sys.argv[1], "rb") as file:
        file.seek(-1, os.SEEK_END)
        torn += file.read() != b"\\n"
Recorder(sys.argv[1], most_bytes=2**40).record([scene("last")])
print(torn, "torn")
""", file)  # fmt: skip
    assert " torn\n" in killed  # beside warnings about unreadable ends
    written = labels(file)
    assert len(written) > 30
    assert written[-1][0].startswith("last")


def test_a_line_of_a_crash_is_repaired(file: Path) -> None:
    scene = json.dumps(scene_of(request("bed", "lamp")))
    for left, kept in [
        (scene[:-9], 0), (scene, 1), (f"{scene}\n{scene[:40]}", 1), (f"{scene}\n{{", 1), ("", 0)
    ]:  # fmt: skip
        file.write_text(left)
        write(file, [request("desk", "lamp")])
        assert len(lines(file)) == kept + 1
    file.write_text("notes of a person")
    write(file, [request("desk", "lamp")])
    assert file.read_text().startswith("{")
    damaged = file.with_name("scenes.jsonl.damaged").read_text().splitlines()
    assert damaged == [scene[:-9], scene[:40], "{", "notes of a person"]


def test_a_full_disk_disturbs_no_question(file: Path) -> None:
    printed = run("""
import logging
logging.basicConfig(format="%(levelname)s %(message)s", stream=sys.stdout)
limit = resource.RLIMIT_FSIZE
resource.setrlimit(limit, (100_000, resource.RLIM_INFINITY))
writer = Recorder(sys.argv[1])
for n in range(20):
    writer.record([scene(n)])
writer.flush()
print(os.path.getsize(sys.argv[1]))
resource.setrlimit(limit, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
writer.record([scene(19)])
writer.flush()
resource.setrlimit(limit, (100_000, resource.RLIM_INFINITY))
writer.record([scene(20)])
""", file).splitlines()  # fmt: skip
    warning = f"WARNING cannot record scenes in {file}"
    # A part of the first line fits, and no part of the second one.
    assert printed[0] == f"{warning}: [Errno 28] No space left on device"
    assert printed[2] == f"{warning}: [Errno 27] File too large"
    assert len(printed) == 3
    assert [int(scene[0].split()[0]) for scene in labels(file)] == [0, 1, 19]
    assert 100_000 * 2 / 3 < int(printed[1]) < 100_000


def test_a_missing_folder_disturbs_no_question(url, tmp_path, caplog):
    file = tmp_path / "later" / "scenes.jsonl"
    writer = Recorder(file)
    with Client(url, record=writer) as scene:
        for _ in range(3):
            assert scene.missing(["bed", "lamp"]).missing
            writer.flush()
        file.parent.mkdir()
        scene.missing(["bed", "lamp"])
        writer.flush()
        assert labels(file) == [["bed", "lamp"]]
        file.rename(tmp_path / "moved.jsonl")
        scene.missing(["bed", "desk"])
        writer.flush()
        assert labels(file) == [["bed", "desk"]]
        file.unlink()
        file.mkdir()
        scene.missing(["bed", "sofa"])
    levels = [one.levelno for one in caplog.records if one.name == recorder.__name__]
    assert levels == [logging.WARNING] * 2


def test_a_pipe_is_refused(file: Path, caplog: pytest.LogCaptureFixture) -> None:
    os.mkfifo(file)
    write(file, [request("bed", "lamp")])
    assert "not a regular file" in caplog.text


def test_a_locked_file_is_left_alone(file: Path, caplog: pytest.LogCaptureFixture) -> None:
    fcntl = pytest.importorskip("fcntl")
    writer = Recorder(file)
    with file.open("w") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        write(writer, [request("bed", "lamp")])
    assert "another program has locked the file" in caplog.text
    assert lines(file) == []
    write(writer, [request("bed", "lamp")])
    assert labels(file) == [["bed", "lamp"]]


def test_the_disk_and_the_memory_have_bounds(file: Path) -> None:
    writer = Recorder(file, most_bytes=20_000)
    for n in range(5000):
        writer.record([request("bed", f"thing {n}")])
        writer.record([request("bed", f"thing {n % 2}")])
    writer.flush()
    assert sorted(file.parent.iterdir()) == [file, file.with_name("scenes.old.jsonl")]
    assert 19_000 < writer.older.stat().st_size <= 20_000
    assert file.stat().st_size <= 20_000
    assert len(writer._recent) == recorder.REMEMBERED
    written = [scene[1] for scene in (*labels(writer.older), *labels(file))]
    assert written == [f"thing {n}" for n in range(5000 - len(written), 5000)]


def test_the_command_records(url: str, file: Path) -> None:
    def scene(*arguments: str) -> Any:
        return CliRunner().invoke(app, [*arguments, "--url", url])

    assert scene("missing", "bed", "lamp", "--record", str(file)).exit_code == 0
    assert scene(f"--record={file}", "outliers", "bed", "lamp").exit_code == 0
    assert labels(file) == [["bed", "lamp"]]
    # The service accepts recorded and confirmed scenes.
    file.write_text(file.read_text().replace("{", '{"confirmed":true,', 1))
    assert scene("missing", f"{file}:1").exit_code == 0
    done = scene("missing", "bed", "lamp", "--record", "scenes.txt")
    assert done.exit_code == 2
    assert done.stderr.strip() == "the name of a file with recorded scenes must end in .jsonl"
