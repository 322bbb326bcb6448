"""Hostile labels: patterns take linear time, readings are few, and searches leave the loop."""

import ast
import importlib
import pkgutil
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import product
from pathlib import Path
from time import thread_time_ns
from types import FrameType
from typing import Any, Final

import pytest
from httpx import AsyncClient

import app
import scene_client
from app.api.questions import QUICK_LABELS, is_quick
from app.errors import RequestError
from app.questions.reading import Limits, read_scene
from app.scene.labels import label_key
from app.scene.nearest import NameIndex
from app.scene.vocabulary import Vocabulary
from scene_client.records import FIELDS, TABLE
from scene_client.schemas import MissingRequest, RoomsRequest
from scene_client.schemas.requests import MAX_LABEL
from tests.http.stores import VOCABULARY
from tests.http.test_problems import problem

METHODS: Final = ("match", "fullmatch", "search", "split", "sub", "findall", "finditer")
# The service cuts these texts before the pattern reads them.
BOUNDED: Final = {"app.settings._SERVICE_LINK"}
LENGTH: Final = 400


def patterns() -> Iterator[tuple[str, re.Pattern[Any], str]]:
    """Yield place, pattern and method of the patterns in the source code of service and client."""
    for package in (app, scene_client):
        for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not info.name.endswith("__main__"):
                yield from _patterns_of(importlib.import_module(info.name))

    for form in (*TABLE["lines"], *TABLE["refused"]):
        for name in {"match", "drop"} & form.keys():
            yield f"formats.json:{form['name']}", re.compile(form[name]), "fullmatch"
    for name in FIELDS["scene"]:
        yield "formats.json:scene", re.compile(name), "fullmatch"


def _patterns_of(module: Any) -> Iterator[tuple[str, re.Pattern[Any], str]]:
    nodes = list(ast.walk(ast.parse(Path(module.__file__).read_text())))
    calls = [node.func for node in nodes if isinstance(node, ast.Call)]
    used = {(ast.unparse(f.value), f.attr) for f in calls if isinstance(f, ast.Attribute)}
    for name, value in vars(module).items():
        pattern = value if isinstance(value, re.Pattern) else getattr(value, "pattern", None)
        if isinstance(pattern, re.Pattern):
            # A pattern that is an argument of a function starts at the first character.
            methods = {m for n, m in used if n == name and m in METHODS} or {"match", "fullmatch"}
            yield from ((f"{module.__name__}.{name}", pattern, m) for m in sorted(methods))
    for node in nodes:
        if isinstance(node, ast.Call) and ast.unparse(node.func) in {f"re.{m}" for m in METHODS}:
            text = ", ".join(ast.unparse(one) for one in (node.args[0], *node.args[2:]))
            pattern = eval(f"re.compile({text})", vars(module))
            yield f"{module.__name__}:{node.lineno}", pattern, ast.unparse(node.func)[3:]


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
    yield from product(("", "a", "the ", "- a"), (*units, "a(b)"), ("!", "\n", "a"))


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
