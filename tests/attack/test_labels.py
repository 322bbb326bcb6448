"""Hostile labels: patterns take linear time, readings are few, and searches leave the loop."""

import ast
import importlib
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from itertools import product
from pathlib import Path
from time import thread_time_ns
from types import FrameType
from typing import Any, Final, TypeAlias

import pytest
from httpx import AsyncClient

import app
from app.api.questions import QUICK_LABELS, is_quick
from app.errors import RequestError
from app.questions.reading import Limits, read_scene
from app.scene.labels import label_key
from app.scene.nearest import NameIndex
from app.scene.vocabulary import Vocabulary
from scene_client import parsing
from scene_client.records import FORMATS, TABLE
from scene_client.schemas import MissingRequest, RoomsRequest
from scene_client.schemas.requests import MAX_LABEL
from tests.http.stores import VOCABULARY
from tests.http.test_problems import problem

METHODS: Final = ("match", "fullmatch", "search", "split", "sub", "findall", "finditer")
# The length of these texts is bounded before the pattern reads them.
BOUNDED: Final = {"app.settings._SERVICE_LINK"}
LENGTH: Final = 400
ROOT: Final = Path(app.__file__).parents[1]
# Patterns of pydantic: its engine takes linear time.
SOURCES: Final = [
    file
    for folder in ("app", "training", "clients")
    for file in sorted((ROOT / folder).rglob("*.py"))
    if not {".venv", "build"} & {*file.parts}
]

Found: TypeAlias = tuple[str, re.Pattern[Any], str]


def patterns() -> Iterator[Found]:
    """Yield place, pattern and method of all patterns of the service, the clients and training."""
    for file in SOURCES:
        yield from _patterns_of(file)
    for form in (*TABLE["lines"], *TABLE["refused"]):
        for name in {"match", "drop"} & form.keys():
            yield f"formats.json:{form['name']}", re.compile(form[name]), "fullmatch"
    for form in TABLE["refused"]:
        start = re.compile(f"{parsing._BEFORE}(?:{form['match']})")
        yield f"start of a file:{form['name']}", start, "match"
    for form in FORMATS:
        for pattern in _in_fields(form):
            yield f"formats.json:{form['name']}", re.compile(pattern), "search"


def _in_fields(spec: Any) -> Iterator[str]:
    """Yield the patterns of the fields of a format."""
    if isinstance(spec, dict) and "path" in spec and "match" in spec:
        yield spec["match"]
    parts = spec.values() if isinstance(spec, dict) else spec if isinstance(spec, list) else ()
    for part in parts:
        yield from _in_fields(part)


def _patterns_of(file: Path) -> Iterator[Found]:
    """Yield the patterns in the source of a module, and those of its tables."""
    tree = ast.parse(source := file.read_text("utf-8"))
    if not re.search(r"\bre\.|\bpattern\b", source):
        return
    name, values = file.relative_to(ROOT).as_posix(), {"re": re}
    if not name.startswith("clients/ros2"):  # its modules need ROS 2
        dotted = name.removeprefix("clients/python/").removesuffix(".py").replace("/", ".")
        values = vars(importlib.import_module(dotted))
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    attributes = [call.func for call in calls if isinstance(call.func, ast.Attribute)]
    used = {(ast.unparse(one.value), one.attr) for one in attributes}
    found = set[re.Pattern[Any]]()
    for place, pattern, default in _compiled(values):
        found.add(pattern)
        of_place = {m for n, m in used if n.partition("[")[0] == place and m in METHODS}
        for method in sorted(of_place or default):
            yield f"{name}:{place}", pattern, method
    for call in calls:
        module, _, method = ast.unparse(call.func).rpartition(".")
        if module != "re" or method not in (*METHODS, "compile"):
            continue
        position = {"compile": 1, "sub": 4, "split": 3}.get(method, 2)
        flags = [one.value for one in call.keywords if one.arg == "flags"]
        text = ", ".join(map(ast.unparse, (call.args[0], *call.args[position:], *flags)))
        try:
            pattern = eval(f"re.compile({text})", {**values, "re": re})
        except (NameError, TypeError):  # the pattern of a table, such as `parsing._MEMBERS`
            assert found, f"{name}:{call.lineno}"
            continue
        if method != "compile":
            yield f"{name}:{call.lineno}", pattern, method
        elif pattern not in found:
            yield from ((f"{name}:{call.lineno}", pattern, m) for m in ("fullmatch", "search"))


def _compiled(values: dict[str, Any]) -> Iterator[tuple[str, re.Pattern[Any], Sequence[str]]]:
    """Yield name, pattern and usual methods of the patterns of a module, also in its tables."""
    for name, value in values.items():
        # A pattern that is an argument of a function starts at the first character.
        alone = getattr(value, "pattern", None) if not isinstance(value, re.Pattern) else value
        if isinstance(alone, re.Pattern):
            yield name, alone, ("fullmatch", "match")
        parts = value.values() if isinstance(value, dict) else value
        for one in parts if isinstance(value, dict | list | tuple) else ():
            if isinstance(one, re.Pattern):
                yield name, one, ("fullmatch",)


PATTERNS: Final = list({(one, m): (place, one, m) for place, one, m in patterns()}.values())


def characters(pattern: re.Pattern[Any]) -> list[str]:
    """Return one character for each combination of the pattern's classes that contain it."""
    source = pattern.pattern if isinstance(pattern.pattern, str) else pattern.pattern.decode()
    atoms = [re.compile(atom) for atom in re.findall(r"\[(?:\\.|[^\]])+\]|\\[\w\W]|\w", source)]
    found: dict[tuple[bool, ...], str] = {}
    for character in "a1_ -.,|()[]{}'\"/:=@%#+!\n" + "".join(re.findall("[a-z]", source)):
        found.setdefault(tuple(atom.match(character) is not None for atom in atoms), character)
    return [*found.values()]


def worst_texts(pattern: re.Pattern[Any]) -> Iterator[tuple[str, str, str]]:
    """Yield start, unit and end of texts that make the pattern try many ways, and fail."""
    letters = characters(pattern)
    units = ("".join(unit) for size in (1, 2, 3) for unit in product(letters, repeat=size))
    # A character that a class excludes makes a long match fail at its end.
    source = pattern.pattern if isinstance(pattern.pattern, str) else pattern.pattern.decode()
    ends = {"!", "\n", "a", *re.findall(r"\[\^([^\\\w])", source)}
    yield from product(("", "a", "the ", "- a"), (*units, "a(b)"), sorted(ends))


def nanoseconds(run: Callable[[], Any], repeats: int) -> int:
    times = []
    for _ in range(repeats):
        began = thread_time_ns()
        run()
        times.append(thread_time_ns() - began)
    return min(times)


@pytest.mark.parametrize(
    ("place", "pattern", "method"), PATTERNS, ids=[f"{place}-{m}" for place, _, m in PATTERNS]
)
def test_the_time_of_a_pattern_is_linear(place: str, pattern: re.Pattern[Any], method: str) -> None:
    if place in BOUNDED:
        return
    call = getattr(pattern, method)
    more = ("",) if method == "sub" else ()

    def time(parts: tuple[str, str, str], length: int, repeats: int) -> int:
        start, unit, end = parts
        text: Any = start + unit * (length // len(unit)) + end
        text = text if isinstance(pattern.pattern, str) else text.encode()
        return nanoseconds(lambda: call(*more, text), repeats)

    quick = 40 * LENGTH
    for parts in worst_texts(pattern):
        # Most texts take so little time that the comparison is superfluous.
        if time(parts, 4 * LENGTH, 1) > 4 * quick:
            # Quadratic time would be 16 times as long. A coarse clock may say that a call took 0.
            assert time(parts, 4 * LENGTH, 5) < 8 * max(quick, time(parts, LENGTH, 5)), parts


WORST: Final = (
    *("a/" * 50, "a/b" * 33, "lamp-a1/" * 12, "the a_1/" * 12, "a/b/c/d/e/f/g/h_1 (x/y/z_1)" * 3),
    *("_" * 100, "the" + "_" * 97, "the_" + "a_" * 48, "a_1" * 33, "a_b1" * 25, "an a_" * 20),
    *("x_(" * 33, "x_(y)" * 20, "a of " * 20, "a photo of " * 9, "a 1 " * 25, "1|" * 50),
    "1_a1|" * 20,
    *("the an_1 (the a_1)" * 5, "s" * 100, "ies" * 33, "ß" * 100, "é_\u0301" * 33),
)
PLAIN_LABELS: Final = ("zxqvwkpm" * 13, "zxqvw kpm " * 10, "Küchengroßgerät " * 7)


def steps(call: Callable[[], Any]) -> int:
    count = 0

    def trace(frame: FrameType, event: str, _: object) -> Any:
        nonlocal count
        frame.f_trace_opcodes, frame.f_trace_lines = True, False
        count += event == "opcode"
        return trace

    label_key.cache_clear()
    before = sys.gettrace()
    sys.settrace(trace)
    try:
        call()
    finally:
        sys.settrace(before)
    return count


def fresh() -> Vocabulary:
    return Vocabulary(VOCABULARY.objects, VOCABULARY.room_types, VOCABULARY.room_aliases)


@pytest.mark.parametrize("is_room", [False, True], ids=["object", "room"])
def test_the_cost_of_a_hostile_label(is_room: bool) -> None:
    def cost(label: str) -> int:
        vocabulary = fresh()
        return steps(lambda: vocabulary.read(label[:MAX_LABEL], is_room=is_room))

    plain = max(map(cost, PLAIN_LABELS))
    for label in WORST:
        assert cost(label) <= 3 * plain, label


def test_a_hostile_label_has_few_guesses(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    seen = 0
    monkeypatch.setattr(NameIndex, "guess", lambda _, name: calls.append(name))
    for label in WORST:
        fresh().guess(label[:MAX_LABEL])
        assert len(calls) <= 3
        seen += len(calls)
        calls.clear()
    assert seen


@pytest.mark.parametrize("treatment", ["error", "ignore", "nearest", "nearest-or-ignore"])
def test_new_labels_leave_the_event_loop(treatment: Any) -> None:
    vocabulary = fresh()
    unknown = [f"zxqv{k}/the a_{k}" for k in range(QUICK_LABELS + 1)]
    scene = MissingRequest(objects=["bed", *unknown], unknown_labels=treatment)
    candidates = {"candidates": unknown, "unknown_labels": treatment}
    rooms = RoomsRequest(objects=["bed"], **candidates)
    requests = (scene, MissingRequest(objects=["bed"], **candidates), rooms)
    few = MissingRequest(objects=["bed", *unknown[1:]], unknown_labels=treatment)
    assert [is_quick(one, vocabulary) for one in requests] == [False] * 3
    assert is_quick(few, vocabulary)
    other = "ignore" if treatment != "ignore" else "error"
    for read_as in (other, treatment):
        # A treatment that searches less does not make the searches of another one quick.
        assert is_quick(scene, vocabulary) == (read_as == treatment and other != "ignore")
        with suppress(RequestError):
            read_scene(scene.model_copy(update={"unknown_labels": read_as}), vocabulary, Limits())
    assert [is_quick(one, vocabulary) for one in requests] == [True, True, False]


def test_words_leave_the_event_loop() -> None:
    vocabulary, options = fresh(), {"unknown_labels": "by-meaning"}
    scene = MissingRequest(objects=["bed", "ottoman"], **options)
    candidates = MissingRequest(objects=["bed"], candidates=["ottoman"], **options)
    for _ in range(2):
        assert not is_quick(scene, vocabulary)
        assert not is_quick(candidates, vocabulary)
        read_scene(scene, vocabulary, Limits())
    spelt = MissingRequest(objects=["bed", "nigthstand"], **options)
    assert not is_quick(spelt, vocabulary)
    read_scene(spelt, vocabulary, Limits())
    assert is_quick(spelt, vocabulary)


def test_lists_of_candidates_leave_the_event_loop() -> None:
    request = MissingRequest(objects=["bed"], candidates=["bed"] * 257)
    assert not is_quick(request, VOCABULARY)


def test_the_memory_for_labels_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.scene.vocabulary._MOST_REMEMBERED", 8)
    vocabulary, words = fresh(), [f"zxqv{k}" for k in range(20)]
    for word in (*words, "z" * 101):
        vocabulary.read(word)
    assert 1 <= sum(vocabulary.remembers(word, ("read",)) for word in words) <= 8
    assert not vocabulary.remembers("z" * 101, ("read",))


async def test_a_long_word_in_a_path_is_refused(client: AsyncClient) -> None:
    answer = await client.get(f"/models/default/vocabulary/the{'_' * 8000}")
    document = problem(answer, 422, "invalid-request")
    assert "100 characters" in document["detail"]
    longest = "the" + "_" * (MAX_LABEL - 3)
    answer = await client.get(f"/models/default/vocabulary/{longest}")
    assert (answer.status_code, answer.json()["word"]) == (200, longest)
