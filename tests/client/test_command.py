"""The command ``scene``: its output, its errors and its exit statuses."""

import json
import os
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from scene_client import Client
from scene_client.command import app
from tests.client.peers import answering, say_nothing
from tests.conftest import run_program

ANSWERED: dict[str, Any] = {
    "model": {"name": "home", "version": "1.0.0", "variant": "rbm", "digest": "0"},
    "request_id": "r",
}
IGNORE = {"unknown_labels": "ignore"}


@pytest.fixture
def scene(url: str, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("SCENE_URL", url)
    monkeypatch.delenv("SCENE_API_KEY", raising=False)

    def run(*arguments: str, stdin: str | None = None) -> Result:
        return CliRunner().invoke(app, list(arguments), input=stdin)

    return run


def test_missing_objects_are_a_table(scene: Any, url: str, tmp_path: Path) -> None:
    line = ("missing", "bed, nightstand,", "--at", "on-top nightstand", "--top-k", "2")
    done = scene(*line)
    assert done.exit_code == 0
    with Client(url) as client:
        found = client.missing(["bed", "nightstand"], at=("on-top", "nightstand"), top_k=2).missing
    assert len(found) == 2
    for entry in found:
        assert entry.label in done.stdout
        assert f"{entry.probability:.3f}" in done.stdout
        place = entry.placements[0]
        assert f"{place.relation} {place.object} {place.probability:.3f}" in done.stdout
    assert "\x1b" not in done.stdout  # colours are only for terminals
    body = {"objects": ["bed", "nightstand"], "at": ["on-top", "nightstand"], "top_k": 2}
    (tmp_path / "scene.json").write_text(json.dumps(body))
    assert scene("missing", str(tmp_path / "scene.json")).stdout == done.stdout


@pytest.mark.parametrize(
    ("line", "fields"),
    [
        ("missing bed --candidates lamp", {"candidates": ["lamp"]}),
        ("missing bed --detail scores", {"detail": "scores"}),
        (
            "relations bed 'garbage bin' --relations 'garbage bin left bed' --include-opposites",
            {"relations": [("garbage bin", "left", "bed")], "include_opposites": True},
        ),
        ("outliers bed --room-type office", {"room_type": "office"}),
        ("missing bed --coverage 0 --unknown-labels ignore", {"coverage": 0.0} | IGNORE),
        (
            "rooms bed --candidates office --candidates bedroom --top-k 2 --unknown-labels ignore",
            {"candidates": ["office", "bedroom"], "top_k": 2} | IGNORE,
        ),
        (
            "generate bed --count 2 --seed 5 --temperature 0.5 --steps 3",
            {"count": 2, "seed": 5, "temperature": 0.5, "steps": 3},
        ),
    ],
)
def test_json_is_the_whole_answer(scene: Any, url: str, line: str, fields: dict[str, Any]) -> None:
    question, *arguments = shlex.split(line)
    done = scene(question, *arguments, "--json")
    assert done.exit_code == 0, done.stderr
    found = json.loads(done.stdout)
    objects = ["bed", "garbage bin"] if "garbage bin" in arguments else ["bed"]
    with Client(url) as client:
        expected = getattr(client, question)(objects, **fields)
    answer = json.loads(expected.model_dump_json(exclude_unset=True))
    assert found == answer | {"request_id": found["request_id"]}


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("models", ("home@1.0.0", "default", "triway", "ready")),
        ("vocabulary", ("garbage bin", "trash can, waste basket", "structure", "homes, shops")),
        ("outliers bed toilet sink", ("toilet", "because")),
        ("outliers bed Couches sink", ("Couches (sofa)",)),
        ("missing bed --candidates couch --candidates desk", ("couch (sofa)", "desk")),
        (
            "generate Couches bed --relations 'Couches on-top bed' --seed 1",
            ("Couches (sofa)", "Couches on-top bed"),
        ),
        ("rooms bed --candidates study", ("room type", "listed as", "office", "study", "1.000")),
        ("relations bed lamp --relations 'lamp on-top bed'", ("if not observed", "on-top")),
        ("outliers bed lamp --relations 'lamp on-top bed'", ("on-top", "bed")),
    ],
)
def test_everything_has_a_table(scene: Any, line: str, words: tuple[str, ...]) -> None:
    done = scene(*shlex.split(line))
    assert done.exit_code == 0
    for word in words:
        assert word in done.stdout


HOME = {"office": ["desk", "chair"], "my room": {"room_type": "bedroom", "objects": ["bed"]}}


def test_where_lists_places_in_words(scene: Any, url: str, tmp_path: Path) -> None:
    searched = ("--searched", "office", "--searched", "my room:bed:0.5")
    line = ("where", "lamp", "-", *searched, "--unknown-labels", "ignore")
    found = json.loads(scene(*line, "--json", stdin=json.dumps(HOME)).stdout)
    rooms = [{"id": "office", "objects": HOME["office"]}, {"id": "my room", **HOME["my room"]}]
    places = [{"room": "office"}, {"room": "my room", "object": "bed", "seen_share": 0.5}]
    with Client(url) as client:
        expected = client.where("lamp", rooms, searched=places, **IGNORE)
    answer = json.loads(expected.model_dump_json(exclude_unset=True))
    assert found == answer | {"request_id": found["request_id"]}
    # A request may have a label, which the command replaces, and further fields.
    request = {"label": "bed", "rooms": rooms, "searched": places[:1], **IGNORE}
    (tmp_path / "home.json").write_text(json.dumps(request))
    again = scene("where", "lamp", str(tmp_path / "home.json"), *searched[2:], "--json")
    found = json.loads(again.stdout)
    assert found == answer | {"request_id": found["request_id"]}


SPOTS = [
    {"room": "bathroom", "probability": 0.5, "relation": "on-top", "object": "sink_1"},
    {"room": "kitchen", "probability": 0.2, "object": "soap_1", "is_listed": True},
    {"room": "bathroom", "probability": 0.07},
    {"room": "bathroom", "probability": 0.03, "relation": "inside", "object": "t7"},
    {"room": "hall", "probability": 0.004},
]


def test_the_table_of_places(scene: Any, peer: Any) -> None:
    share = {"room": "bathroom", "probability": 0.6}
    body = ANSWERED | {"label": "soap", "listed_as": "Soaps", "rooms": [share]}
    body |= {"places": SPOTS, "not_here": 0.15}
    started = peer(answering(json.dumps(body).encode()))
    home = {"bathroom": [{"id": "sink_1", "label": "sink"}, {"id": "t7", "label": "bathtub"}]}
    done = scene("where", "Soaps", "-", "--url", started.url, stdin=json.dumps(home))
    lines = [line.strip() for line in done.stdout.splitlines()]
    assert lines[0] == "Soaps (soap)"
    # The last place is unlikely, and the answer leaves further places out.
    assert [" ".join(line.split()) for line in lines[4:] if line] == [
        "bathroom: on top of sink_1 0.500",
        "kitchen: seen there (soap_1) 0.200",
        "bathroom: elsewhere 0.070",
        "bathroom: inside bathtub (t7) 0.030",
        "at another place 0.050",
        "not here 0.150",
    ]


def test_ids_without_a_meaning_have_their_label(scene: Any, peer: Any) -> None:
    """The ids of a `Home` are numbers of tracks."""
    spot = {"room": "bathroom", "probability": 0.5, "relation": "on-top", "object": "t12"}
    body = ANSWERED | {"label": "soap", "places": [spot], "rooms": [], "not_here": 0.5}
    started = peer(answering(json.dumps(body).encode()))
    rooms = {"hall": [{"id": "t12", "label": "bed"}], "bathroom": [{"id": "t12", "label": "sink"}]}
    done = scene("where", "soap", "-", "--url", started.url, stdin=json.dumps(rooms))
    assert "bathroom: on top of sink (t12)" in done.stdout


def test_outliers_show_doubt_and_several_rooms(scene: Any, peer: Any) -> None:
    entry = {"label": "toilet", "probability": 0.9, "log_odds": 2.2, "is_outlier": False}
    rooms = [{"room_type": "bedroom", "objects": ["bed"]}, {"room_type": "bath", "objects": ["wc"]}]
    labels = [{"label": "bowl", "probability": 0.84}, {"label": "cup", "probability": 0.16}]
    body = ANSWERED | {
        "misplaced": [],
        "outliers": [entry | {"object": "wc", "real": 0.2, "reason": "misdetection"}],
        "resolved": [{"object": "cup_1", "labels": labels}],
        "warnings": [
            {"code": "several-rooms", "message": "two rooms", "objects": [], "rooms": rooms}
        ],
    }
    started = peer(answering(json.dumps(body).encode()))
    done = scene("outliers", "bed", "--url", started.url)
    assert "real" in done.stdout.splitlines()[1]
    assert done.stdout.splitlines()[3].split() == [
        *("wc", "toilet", "0.900", "+2.20", "0.200", "misdetection")
    ]
    assert done.stderr.splitlines() == [
        "cup_1: bowl 0.84, cup 0.16 (as the other objects decide)",
        "several-rooms: two rooms",
        "  bedroom: bed",
        "  bath: wc",
    ]


FILES = {
    "rooms.json": b'{"office": ["bed"]}',
    "broken.json": b'{"office": ',
    "numbers.json": b"[1]",
    "newer.json": b'{"format": "scene-home", "version": 99, "rooms": {}}',
    "damaged.json": b'{"format": "scene-home", "version": 1, "rooms": [], "tracks": 7}',
    "two.jsonl": b"{}\n{}",
    "bare.jsonl": b'{"scene_id": "a"}',
    **{
        f"names{k}": text
        for k, text in enumerate((b"", b"[1, 2]", b'[{"id": 1}]', b"7", b"\0\xd8"))
    },
}


@pytest.mark.parametrize(
    ("line", "code", "words"),
    [
        ("missing", 2, ["the objects are missing: give labels"]),
        ("missing bed --at 'over bed'", 2, ["--at must be a relation and an object"]),
        ("missing bed --relations 'bed over lamp'", 2, ["--relations must be"]),
        ("missing bed lamp --relations 'lamp ontop bed'", 2, ["(did you mean on-top?)"]),
        ("missing nowhere.json", 2, ["nowhere.json"]),
        ("missing bed nowhere.json", 2, ["nowhere.json is a whole scene"]),
        ("missing -", 2, ["not JSON"]),
        ("missing bed --timeout 0", 2, ["the timeout must be"]),
        ("--url robot missing bed", 2, ["http://"]),
        ("missing bed --offline nowhere", 2, ["directory"]),
        ("missing ./two.jsonl", 2, ["has 2 scenes (1, 2): choose one, such as ./two.jsonl:1"]),
        ("missing ./two.jsonl:3", 2, ["no scene 3; it has 2 scenes (1, 2)"]),
        (
            "missing ./bare.jsonl:1",
            2,
            ["this is a JSON object with the fields scene_id, and no known format"],
        ),
        ("where lamp", 2, ["the rooms are missing"]),
        ("where lamp nowhere.json", 2, ["nowhere.json: no such file"]),
        ("where lamp broken.json", 2, ["broken.json: this is not JSON"]),
        ("where lamp numbers.json", 2, ["numbers.json: this has no rooms"]),
        ("where lamp newer.json", 2, ["newer.json has version 99"]),
        ("where lamp damaged.json", 2, ["damaged.json is not a whole file of a home"]),
        ("where lamp rooms.json --searched office:bed:all", 2, ["--searched must be ROOM"]),
        ("where lamp rooms.json --searched attic", 1, ["/searched/0/room"]),
        *[(f"missing 59 --label-map ./names{k}", 2, ["--label-map"]) for k in range(5)],
        (
            "missing bed nightstnad",
            1,
            [
                '"nightstnad": the model does not know',
                "did you mean nightstand",
                "/problems/unknown-labels",
            ],
        ),
        ("missing bed --at 'on-top bedd'", 1, ['"bedd": no entry of']),
        ("generate bedroom", 1, ["it is a room type: send it as"]),
        # Port 9 is "discard": nothing listens there, and connecting fails at once.
        ("missing bed --url http://127.0.0.1:9", 3, []),
        ("generate --count 64 --steps 500 --timeout 0.01", 4, []),
    ],
)
def test_exit_status_and_reason_of_a_failure(scene, tmp_path, monkeypatch, line, code, words):
    monkeypatch.chdir(tmp_path)
    for name, content in FILES.items():
        (tmp_path / name).write_bytes(content)
    done = scene(*shlex.split(line), stdin="{")
    assert (done.exit_code, done.stdout) == (code, "")
    assert [word for word in words if word not in done.stderr] == []
    assert code == 1 or len(done.stderr.splitlines()) <= 1
    # Pointers are only for faults of a request.
    assert code == 1 or "#" not in done.stderr


@pytest.mark.parametrize(
    ("status", "body", "code"),
    [(b"503 No", b"{}", 5), (b"429 No", b"{}", 5), (b"500 No", b"{}", 6), (b"200 OK", b"{}", 6)],
)
def test_status_of_errors(scene: Any, peer: Any, status: bytes, body: bytes, code: int) -> None:
    done = scene("models", "--url", peer(answering(body, status, b"60")).url)
    assert (done.exit_code, done.stdout) == (code, "")


def test_markup_in_an_answer_is_text(scene: Any, peer: Any) -> None:
    entry = {"object": "[red]x[/red]", "label": ":bed:", "probability": 0.1, "log_odds": 0.0}
    body = ANSWERED | {"outliers": [entry | {"is_outlier": False}], "misplaced": []}
    done = scene("outliers", "bed", "--url", peer(answering(json.dumps(body).encode())).url)
    assert done.stdout.splitlines()[3].split() == ["[red]x[/red]", ":bed:", "0.100", "+0.00"]


def test_exit_status_of_ready(scene: Any, peer: Any) -> None:
    assert scene("ready").exit_code == 0
    assert scene("ready", "--url", "http://127.0.0.1:9").exit_code == 3
    assert scene("ready", "--url", peer(say_nothing).url, "--timeout", "0.1").exit_code == 4
    starting = peer(answering(b"{}", b"503 No"))
    assert scene("ready", "--url", starting.url).exit_code == 5
    # The command does not retry: a script that waits for a service asks in a loop.
    assert starting.connections == 1


def test_the_key_of_the_environment(scene: Any, peer: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    heads: list[bytes] = []
    monkeypatch.setenv("SCENE_API_KEY", "k" * 16)
    started = peer(answering(b'{"models":[],"aliases":{}}', heads=heads))
    assert scene("models", "--url", started.url).exit_code == 0
    assert b"x-api-key: " + b"k" * 16 in heads[0].lower()


def test_options_declare_the_conventions_of_a_file(scene: Any, tmp_path: Path) -> None:
    """A chair beside a bed, as z up in metres, and as y up in centimetres at the bottom."""
    plain, other = tmp_path / "plain.csv", tmp_path / "other.csv"
    head = "label,x,y,z,sx,sy,sz,yaw\n"
    plain.write_text(f"{head}bed,2,1,.4,2,1.6,.8,.5\nchair,2,-.5,.45,.5,.6,.9,0\n")
    other.write_text(f"{head}bed,-100,0,-200,160,80,200,.5\nchair,50,0,-200,60,90,50,0\n")
    options = ("--up", "y", "--units", "cm", "--box-origin", "bottom", "--json")
    usual, declared = (
        scene("relations", str(plain), "--json"),
        scene("relations", str(other), *options),
    )
    assert declared.exit_code == 0, declared.stderr
    answers = [json.loads(done.stdout) | {"request_id": ""} for done in (usual, declared)]
    assert answers[0]["observed_relations"]
    assert answers[0] == answers[1]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("scene mi", "missing"),
        ("scene missing --room", "--room-type"),
        ("scene outliers --sensitivity m", "medium"),
    ],
)
def test_bash_completes_commands_options_and_values(words: str, expected: str) -> None:
    variables = {"COMP_WORDS": words, "COMP_CWORD": str(len(words.split()) - 1)}
    environment = os.environ | variables | {"_SCENE_COMPLETE": "complete_bash"}
    done = run_program(sys.executable, "-m", "scene_client", env=environment)
    assert done.stdout.split() == [expected]


def test_a_label_with_the_name_of_a_file_is_a_label(
    scene: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lamp").write_text("bed, pillow\n")
    assert "lamp" in scene("outliers", "bed", "lamp").stdout
    assert "pillow" in scene("outliers", "lamp").stdout
