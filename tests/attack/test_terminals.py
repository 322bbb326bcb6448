"""Texts of others on a terminal: escaped, on the line of the program that prints them."""

import io
import json
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread
from typing import Any

import pytest
from rich.status import Status
from rich.table import Table
from typer.testing import CliRunner, Result

from app.registry import Store, load_model_set
from app.registry.__main__ import main
from app.serving.logs import Masked
from scene_client import HomeFileError, MessageError, ProblemError
from scene_client.command import app
from scene_client.errors import DeadlineError, problem_of
from scene_client.schemas import MAX_LABEL
from scene_client.untrusted import printable, printable_json
from tests.client.peers import Peer, answering
from tests.registry.small_artifacts import description, rewrite_manifest, state
from training.cli import app as training
from training.datasets.console import console as training_console

HOSTILE = "\x1b]0;owned\x07\x1b[2Jlamp\nsofa\r\x00\x7f\x9b31m\u202egnp.exe\u2066\u200b\u2028\ud83d"
"""Sequences of terminals, line breaks, control characters of both sets, and marks of direction."""
SENT = HOSTILE.removesuffix("\ud83d")  # JSON cannot have half of a character
ESCAPED = r"\x1b]0;owned\x07\x1b[2Jlamp\nsofa\r\x00\x7f\x9b31m\u202egnp.exe\u2066\u200b\u2028\ud83d"


def is_plain(text: str, lines: int | None = None) -> bool:
    """Return whether a terminal shows each character of a text, in so many lines."""
    shown = text.split("\n")
    return all(map(str.isprintable, shown)) and lines in (None, len(shown) - 1)


def test_a_text_is_escaped() -> None:
    assert printable(HOSTILE) == ESCAPED
    for text in ("sofa", "Küchengerät", "椅子", "كرسي", "כיסא", "🛋", ""):
        assert printable(text) == text


def test_json_keeps_its_value() -> None:
    value = {SENT: [SENT, 'Kü\\"\n', "\U000e0001\U0010ffff"]}
    for text in (json.dumps(value, ensure_ascii=False), json.dumps(value)):
        assert is_plain(printable_json(text))
        assert json.loads(printable_json(text)) == value


# ------------------------------------------------------------------------------ the command scene


@contextmanager
def peer(body: Any, status: bytes = b"200 OK") -> Iterator[str]:
    with Peer(answering(json.dumps(body).encode(), status)) as server:
        Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        yield server.url
        server.shutdown()


def scene(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments), input='{"a": ["bed"]}')


MODEL = {"name": SENT, "version": SENT, "variant": SENT, "digest": SENT}
WARNING = {"code": "several-rooms", "message": SENT, "objects": [SENT]}
WARNING |= {"rooms": [{"room_type": SENT, "objects": [SENT]}]}
MAPPED = {"label": SENT, "class": SENT, "similarity": 0.5, "rule": "meaning"}
COMMON = {
    "model": MODEL, "request_id": SENT, "warnings": [WARNING], "mapped": [MAPPED],
    "ignored": [SENT],
    "resolved": [{"object": SENT, "labels": [{"label": SENT, "probability": 0.5}]}],
}  # fmt: skip
RELATION = {"subject": SENT, "relation": "left", "object": SENT, "probability": 0.5}
BECAUSE = [{"object": SENT, "log_odds_change": 1.0}]
OUTLIER = {"object": SENT, "label": SENT, "listed_as": SENT, "probability": 0.5, "log_odds": 0.1}
OUTLIER |= {"is_outlier": True, "because": BECAUSE, "usually_with": [SENT], "broader": [SENT]}
MISSING = {"label": SENT, "listed_as": SENT, "probability": 0.5, "log_odds": 0.1}
MISSING |= {"because": BECAUSE}
MISSING |= {"placements": [{"relation": "on-top", "object": SENT, "probability": 0.5}]}
LEFT = {"subject": "a", "relation": "left", "object": "b"}
ANSWERS: dict[str, dict[str, Any]] = {
    "relations bed": {"relations": [RELATION | {"observed": False}], "disagreements": []},
    "missing bed": {"missing": [MISSING]},
    "outliers bed": {"outliers": [OUTLIER], "misplaced": [RELATION | {"is_misplaced": True}]},
    "rooms bed": {
        "room_types": [
            {"room_type": SENT, "listed_as": [SENT], "probability": 0.5, "because": BECAUSE}
        ]
    },
    "generate bed": {
        "seed": 1,
        "listed_as": {"a": SENT},
        "scenes": [{"objects": [SENT, "a"], "log_score": 0.1, "relations": [LEFT]}],
    },
    "where bed -": {
        "label": SENT,
        "listed_as": SENT,
        "rooms": [{"room": SENT, "probability": 0.5}],
        "places": [{"room": SENT, "object": SENT, "relation": "on-top", "probability": 0.5}],
        "not_here": 0.5,
    },
}


@pytest.mark.parametrize("line", ANSWERS)
def test_the_answer_of_a_hostile_server(line: str) -> None:
    with peer(COMMON | ANSWERS[line]) as url:
        done = scene(*line.split(), "--url", url)
        as_json = scene(*line.split(), "--url", url, "--json")
    assert (done.exit_code, as_json.exit_code) == (0, 0), done.output
    assert is_plain(done.stdout)
    assert is_plain(as_json.stdout, lines=1)
    assert json.loads(as_json.stdout)["request_id"] == SENT
    escaped = printable(SENT)
    assert escaped in done.stdout
    # A line of the table for each entry, and one line for each note.
    assert is_plain(done.stderr, lines=4)
    assert done.stderr.count(escaped) == 8


@pytest.mark.parametrize("line", ["models", "vocabulary"])
def test_the_lists_of_a_hostile_server(line: str) -> None:
    version = {
        "version": SENT,
        "status": "refused",
        "reason": SENT,
        "variant": SENT,
        "aliases": [SENT],
    }
    failure = {"subject": SENT, "reason": SENT, "detail": SENT}
    body: dict[str, Any] = {"models": [{"name": SENT, "versions": [version]}], "aliases": {}}
    body |= {"failures": [failure]}
    if line == "vocabulary":
        body = {"model": MODEL, "objects": [{"label": SENT, "aliases": [SENT], "structure": False}]}
        body |= {"room_types": [SENT], "profiles": [SENT], "relations": ["left"]}
    with peer(body) as url:
        done = scene(line, "--url", url)
    assert done.exit_code == 0, done.output
    assert is_plain(done.stdout)
    assert done.stdout.count(printable(SENT)) >= 4


def problem(**members: Any) -> dict[str, Any]:
    body = {"type": SENT, "title": SENT, "status": 422, "detail": SENT, "instance": SENT}
    return body | {"request_id": SENT} | members


def test_the_problem_of_a_hostile_server() -> None:
    error = {"pointer": SENT, "message": SENT, "suggestions": [SENT]}
    with peer(problem(errors=[error, error]), b"422 No") as url:
        done = scene("missing", "bed", "--url", url)
    assert done.exit_code == 1
    assert is_plain(done.stderr, lines=3)
    assert done.stderr.count(printable(SENT)) == 3 + 2 * 3


@pytest.mark.parametrize(
    "error",
    [
        problem_of(422, {}, json.dumps(problem()).encode()),
        DeadlineError(HOSTILE.replace("\n", " ")),
        HomeFileError(f"{HOSTILE}".replace("\n", " ")),
        MessageError(HOSTILE),
    ],
    ids=lambda error: type(error).__name__,
)
def test_the_text_of_an_error_suits_the_log_of_a_robot(error: Exception) -> None:
    assert is_plain(str(error), lines=0)
    assert not is_plain(str(error.detail if isinstance(error, ProblemError) else error.args[0]))


FILES: dict[str, Callable[[], str]] = {
    "unread.json": lambda: json.dumps([{"class": "a", "confidence": 1, f"box{SENT}": [1, 2]}] * 2),
    "names.json": lambda: json.dumps({f"{SENT}{n}": ["bed"] for n in range(3)}),
    "fields.json": lambda: json.dumps({SENT: 1}),
    "score.json": lambda: json.dumps([{"class": "a", "confidence": SENT, "bbox": [1, 2, 3, 4]}]),
    "label.json": lambda: json.dumps(
        [{"class": one, "confidence": 1, "bbox": [1, 2, 3, 4]} for one in (SENT, "bed")]
    ),
    "root.xml": lambda: "<a\u202eb/>",
    "text.txt": lambda: f"[] {SENT}\n? : {SENT}!",
}


@pytest.mark.parametrize("name", FILES)
def test_the_texts_of_a_hostile_file(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text(FILES[name](), "utf-8")
    done = scene("missing", str(path), "--url", "http://127.0.0.1:9")
    assert done.exit_code in (2, 3)
    assert is_plain(done.stderr)
    assert len(done.stderr.splitlines()) <= 3


# -------------------------------------------------------------------------- a store of models


def thing(**members: Any) -> dict[str, Any]:
    return {"label": "bed", "aliases": [], "structure": False} | members


PLACES: dict[str, Callable[[dict[str, Any], str], object]] = {
    "label": lambda m, text: m["vocabulary"]["objects"].__setitem__(0, thing(label=text)),
    "alias": lambda m, text: m["vocabulary"]["objects"].__setitem__(0, thing(aliases=[text])),
    "room type": lambda m, text: m["vocabulary"]["room_types"].__setitem__(0, text),
    "room alias": lambda m, text: m["vocabulary"].update(room_aliases={"bedroom": [text]}),
    "profile": lambda m, text: m["vocabulary"].update(profiles=[text]),
    "source": lambda m, text: m["data"][0].update(source=text),
    "terms of a source": lambda m, text: m["data"][0].update(terms=text),
    "metric": lambda m, text: m["metrics"][0].update(metric=text),
    "terms": lambda m, text: m.update(terms=text),
    "training": lambda m, text: m["training"].update(parent={"name": [text], "version": "1.0.0"}),
    "key of training": lambda m, text: m["training"].update({text: 1}),
    "library": lambda m, text: m["libraries"].update({"torch": text}),
    "name of a library": lambda m, text: m["libraries"].update({text: "1"}),
    "example": lambda m, text: m.update(examples=[{"name": text, "scene": {"objects": ["bed"]}}]),
    "scene": lambda m, text: m.update(examples=[{"name": "a", "scene": {"objects": [text]}}]),
    "unknown field": lambda m, text: m.update({text: 1}),
    "tensor": lambda m, text: m["tensors"].update({text: m["tensors"]["b"]}),
}


@pytest.fixture
def store(tmp_path: Path) -> Path:
    Store(tmp_path / "store").publish(description("hostile"), state())
    return tmp_path / "store"


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("text", ["\x1b[2Jlamp", "lamp\nbed", "\x9b31mlamp", "\u202epmal"])
def test_a_manifest_with_such_texts_is_refused_in_one_line(
    place: str, text: str, store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rewrite_manifest(store / "hostile" / "1.0.0", lambda members: PLACES[place](members, text))
    assert main(["list", "--store", str(store)]) == 0
    shown = capsys.readouterr().out
    assert is_plain(shown, lines=1)
    assert "hostile@1.0.0  refused: " in shown


def test_the_names_of_a_manifest_are_bounded(store: Path) -> None:
    for length in (MAX_LABEL, MAX_LABEL + 1):
        text = "lamp " * 20 + "s" * (length - 100)
        for place in ("label", "alias", "room type", "room alias"):
            folder = store / "hostile" / "1.0.0"
            before = (folder / "manifest.json").read_bytes()
            rewrite_manifest(folder, lambda m, place=place, text=text: PLACES[place](m, text))
            failures = load_model_set(Store(store)).failures.values()
            assert [one.reason.endswith("100 characters") for one in failures] == (
                [True] if length > MAX_LABEL else []
            )
            (folder / "manifest.json").write_bytes(before)


def test_the_command_of_the_registry_escapes_the_name_of_a_store(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["list", "--store", str(tmp_path / SENT.replace("\0", ""))]) == 1
    assert is_plain(capsys.readouterr().err, lines=1)


# ---------------------------------------------------------------------------- log of the service


@pytest.mark.parametrize("style", ["plain", "json"])
def test_a_line_of_the_log_is_one_line(style: Any) -> None:
    record = logging.LogRecord("app", logging.ERROR, "", 1, "model %s", (SENT,), None)
    text = Masked(style).format(record)
    assert is_plain(text, lines=0)
    if style == "json":
        assert json.loads(text)["message"] == f"model {SENT}"
    else:
        assert text.endswith(f" app: model {printable(SENT)}")


def test_a_traceback_keeps_its_lines() -> None:
    try:
        raise ValueError(SENT)
    except ValueError as error:
        record = logging.LogRecord("app", logging.ERROR, "", 1, SENT, (), None)
        record.exc_info = (type(error), error, error.__traceback__)
    lines = Masked("plain").format(record).split("\n")
    assert lines[1] == "Traceback (most recent call last):"
    assert is_plain("\n".join(lines))


# -------------------------------------------------------------------------- commands of training


def shown(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    with pytest.raises(SystemExit) as ended:
        training(list(arguments), prog_name="training")
    captured = capsys.readouterr()
    return int(ended.value.code or 0), captured.out + captured.err


MARKED = "[red]sofa[/red] :bed: [/]"


def test_the_commands_of_training_print_names_as_they_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scenes = [
        {"scene_id": f"{n} {SENT}", "group": f"g{n}", "objects": ["bed", MARKED, f"lamp {n}"]}
        for n in range(40)
    ]
    # The command lists the scenes with one object.
    scenes += [{"scene_id": name, "objects": ["bed"]} for name in (MARKED, SENT)]
    path = tmp_path / "scenes.jsonl"
    path.write_text("".join(json.dumps(scene) + "\n" for scene in scenes))
    _, text = shown(capsys, "init", "my-lab", str(path), "--output", str(tmp_path / "lab"))
    assert is_plain(text)
    assert f"    - {MARKED}\n" in text
    assert f"    - {printable(SENT)[:40]}" in text
    adapted = ("adapt", "default", str(path), "--name", "h", "--store", str(tmp_path / "none"))
    _, text = shown(capsys, *adapted)
    assert is_plain(text)


def test_an_error_of_a_file_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "scenes.jsonl"
    relation = [["bed", "left", f"{SENT}{MARKED}"]]
    path.write_text(json.dumps({"objects": ["bed"], "relations": relation}) + "\n")
    code, text = shown(capsys, "init", "my-lab", str(path), "--output", str(tmp_path / "lab"))
    assert code == 1
    assert is_plain(text, lines=1)
    assert MARKED in text


def test_tables_states_and_progress_are_escaped() -> None:
    stream = io.StringIO()
    console = type(training_console)(markup=False, emoji=False, file=stream)
    table = Table("a", SENT, title=SENT)
    table.add_row(MARKED, SENT)
    console.print(table)
    console.print(Status(SENT))
    console.print(SENT, MARKED)
    assert is_plain(stream.getvalue())
    assert stream.getvalue().count(r"\x1b[2Jlamp") >= 3
    assert stream.getvalue().count(MARKED) == 2
