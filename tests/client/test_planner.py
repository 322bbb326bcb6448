"""The tools for planners: by function, over stdio and over HTTP, and their schemas."""

import json
import os
import re
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import Any

import httpx2
import jsonschema
import pytest
from mcp import Client as McpClient
from mcp import StdioServerParameters
from mcp.client.streamable_http import streamable_http_client
from typer.testing import CliRunner

from scene_client import Client, phrases, planner
from scene_client.command import app
from tests.client.peers import answering, say_nothing
from tests.conftest import REPOSITORY, run_program

PROGRAM = (sys.executable, "-m", "scene_client", "mcp")
PLAIN = {name: value for name, value in os.environ.items() if name[:6] != "SCENE_"}
HOME = {"office": ["desk", "chair"], "bathroom": ["toilet", "sink"]}
CALLS: list[tuple[str, dict[str, Any], str]] = [
    ("find_out_of_place", {"objects": ["bed", "pillow", "toilet", "desk"]}, "at most|Out of place"),
    ("suggest_missing", {"objects": ["bed"], "at": "on the bed"}, r"on top of bed|no further"),
    ("locate_object", {"thing": "lamp", "rooms": HOME, "searched": ["office: desk"]}, "In none of"),
    ("identify_room", {"objects": ["toilet", "sink"], "candidates": ["office"]}, "office .>0.99"),
    (
        "relate_objects",
        {"objects": ["desk", "lamp"], "relations": ["lamp on top of the desk"]},
        "Known: lamp on top of desk",
    ),
    ("imagine_room", {"room_type": "bedroom"}, r"bedroom \(>0.99\)"),
]
"""A call of each tool, and a pattern of its answer. The weights of the machine are random."""


@pytest.fixture(scope="module")
def scene(url: str) -> Iterator[Client]:
    with Client(url, timeout=60) as client:
        yield client


# ------------------------------------------------------------------------------------ servers


@contextmanager
def http_server(*options: str, **variables: str) -> Iterator[str]:
    """Start a server over HTTP, and yield its address."""
    command = (*PROGRAM, "--http", "0", *options)
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, cwd=REPOSITORY, env=PLAIN | variables
    ) as process:
        try:
            assert process.stderr is not None
            yield process.stderr.readline().removeprefix("MCP server: ").strip()
        finally:
            process.terminate()


@asynccontextmanager
async def over_http(address: str, **headers: str) -> AsyncIterator[McpClient]:
    async with (
        httpx2.AsyncClient(headers=headers) as http,
        McpClient(streamable_http_client(address, http_client=http)) as client,
    ):
        yield client


def over_stdio(url: str, **variables: str) -> McpClient:
    arguments = [*PROGRAM[1:], "--url", url]
    return McpClient(
        StdioServerParameters(
            command=PROGRAM[0], args=arguments, env=PLAIN | variables, cwd=REPOSITORY
        )
    )


async def check_tools(client: McpClient, scene: Client) -> None:
    """Check that a server lists and runs the same tools as the functions."""
    listed = (await client.list_tools()).tools
    anthropic = [
        {"name": one.name, "description": one.description, "input_schema": one.input_schema}
        for one in listed
    ]
    assert anthropic == planner.schemas("anthropic")
    assert [name for name, _, _ in CALLS] == list(planner.TOOLS)
    for name, arguments, pattern in CALLS:
        answer = await client.call_tool(name, arguments)
        (content,) = answer.content
        assert re.search(pattern, content.text), content.text
        assert content.text == planner.call(scene, name, arguments)
        assert not answer.is_error
    refused = await client.call_tool("locate_object", {"thing": "lamp", "rooms": "office"})
    assert refused.is_error
    assert refused.content[0].text == (
        "Correct the arguments: #/rooms: must be a JSON object, not a string."
    )


async def test_a_client_over_stdio(url: str, scene: Client) -> None:
    async with over_stdio(url) as client:
        await check_tools(client, scene)


async def test_a_client_over_http(url: str, scene: Client) -> None:
    with http_server("--url", url) as address:
        async with over_http(address) as client:
            await check_tools(client, scene)
        # A page of another site must not reach the server through the browser of its user.
        async with httpx2.AsyncClient() as browser:
            for header, status in (("Host", 421), ("Origin", 403)):
                headers = {header: "http://evil.example", "Accept": "application/json"}
                response = await browser.post(address, json={}, headers=headers)
                assert response.status_code == status


async def test_the_api_key_is_passed_on(peer: Any) -> None:
    heads: list[bytes] = []
    service = peer(answering(heads=heads)).url
    call = ("identify_room", {"objects": ["bed"]})
    async with over_stdio(service, SCENE_API_KEY="of-the-user") as client:
        await client.call_tool(*call)
    # The key of the process is for its own user, and not for each client of the port.
    with http_server("--url", service, SCENE_API_KEY="of-the-process") as address:
        for headers in ({"X-API-Key": "first"}, {"Authorization": "Bearer second"}, {}):
            async with over_http(address, **headers) as client:
                await client.call_tool(*call)
    keys = [re.findall(rb"(?i)x-api-key: (\S+)", head) for head in heads]
    assert keys == [[b"of-the-user"], [b"first"], [b"second"], []]


# ------------------------------------------------------------------------------------ answers


def test_omitted_and_guessed_words_come_first(scene: Client) -> None:
    objects = ["bed", "zxqvw", "nigthstand", "ottoman", "toilet"]
    answer = planner.call(scene, "find_out_of_place", {"objects": objects, "room_type": "zxqvx"})
    first, second, third, rest = answer.split(". ", 3)
    assert first.startswith('I do not know "zxqvw", "zxqvx" and left them out')
    assert second == 'I read "nigthstand" as nightstand (a guess)'
    assert third.startswith('I know "ottoman" only by its meaning, near ')
    # The service raises no alarm about such a word, so the answer must not call it fitting.
    assert re.search(r"Not judged, [^:]*: ottoman\.", rest)


def test_a_room_of_an_unknown_kind_is_named(scene: Client) -> None:
    rooms = {"zxqvw": ["bed"], "study": ["desk"]}
    answer = planner.call(scene, "locate_object", {"thing": "lamp", "rooms": rooms})
    first, second, _ = answer.split(". ", 2)
    assert first.startswith('I do not know the kind of room "zxqvw", and go by the objects')
    assert second == 'I read "study" as office'


def test_searched_places_are_marked_and_the_best_other_one_is_named(peer: Any) -> None:
    spots = [
        {"room": "store", "relation": "on-top", "object": "t1", "probability": 0.4},
        {"room": "ward", "relation": "under", "object": "bed", "probability": 0.12},
        {"room": "ward", "relation": "on-top", "object": "t2", "probability": 0.11},
    ]
    rooms = [{"room": "store", "probability": 0.4}, {"room": "ward", "probability": 0.25}]
    answer = {"label": "mug", "places": spots, "rooms": rooms, "not_here": 0.35}
    body = json.dumps(ENTRIES | answer).encode()
    things = {"store": [{"id": "t1", "label": "shelf"}]}
    things["ward"] = [{"id": "bed", "label": "bed"}, {"id": "t2", "label": "desk"}]
    call = {"thing": "mug", "rooms": things}
    with Client(peer(answering(body)).url) as client:
        found = planner.call(client, "locate_object", call)
        assert "Best" not in found
        assert "store (0.40; on top of shelf (t1) 0.40)" in found
        call["searched"] = ["store", "ward: bed", "ward: desk: 0.2"]
        found = planner.call(client, "locate_object", call)
    assert found.split(". ") == [
        "I am not sure about mug",
        "Possible: store (0.40; already searched, on top of shelf (t1) 0.40), ward (0.25; "
        "under bed 0.12 (already searched), on top of desk (t2) 0.11)",
        "Best unsearched place: on top of desk (t2) in ward (0.11)",
        "In none of these rooms: 0.35.",
    ]


ENTRIES: dict[str, Any] = {
    "model": {"name": "home", "version": "1.0.0", "variant": "rbm", "digest": "0"},
    "request_id": "r",
}


@pytest.mark.parametrize(
    ("types", "sentences"),
    [
        (
            {"kitchen": 0.87, "office": 0.06, "bar": 0.04},
            "This is probably: kitchen (0.87). Possib",
        ),
        (
            {"kitchen": 0.3, "office": 0.2},
            "I am not sure which room this is. Possible: kitchen (0.",
        ),
        (
            {"kitchen": 0.2},
            "I am not sure which room this is. Possible: kitchen (0.20). No object",
        ),
    ],
)
def test_a_flat_distribution_is_no_fact(peer: Any, types: dict[str, float], sentences: str) -> None:
    because = [{"object": "pan", "log_odds_change": 1.2}]
    found = [{"room_type": name, "probability": share} for name, share in types.items()]
    found[0] |= {"because": because if len(types) > 1 else []}
    body = json.dumps(ENTRIES | {"room_types": found}).encode()
    with Client(peer(answering(body)).url) as client:
        answer = planner.call(client, "identify_room", {"objects": ["pan", "pot"]})
    assert answer.startswith(sentences)
    assert "bar" not in answer


def outlier(name: str, probability: float, **fields: Any) -> dict[str, Any]:
    entry = {"object": name, "label": name, "probability": probability, "log_odds": 0.0}
    return entry | {"is_outlier": False} | fields


def test_every_verdict_and_every_warning_is_said(peer: Any) -> None:
    wrong = {"subject": "pan", "relation": "above", "object": "floor", "probability": 0.999}
    doubt = {"subject": "mug", "relation": "on-top", "object": "bed", "probability": 0.12}
    rooms = [{"room_type": "bar", "objects": ["pan"]}, {"room_type": "gym", "objects": ["cat"]}]
    several = {"code": "several-rooms", "message": "", "objects": [], "rooms": rooms}
    rare = {"code": "not-judged", "message": "too few scenes", "objects": ["odd"]}
    outliers = [
        outlier("toilet", 0.97, is_outlier=True, usually_with=["sink", "shower"]),
        outlier("odd", 0.9),
        outlier("ghost", 0.8, real=0.1, reason="misdetection"),
        outlier("mug", 0.3),
        outlier("pan", 0.04),
        outlier("cat", 0.0, log_odds=None),
    ]
    misplaced = [wrong | {"is_misplaced": True, "reason": "floats"}, doubt]
    answer = {"outliers": outliers, "misplaced": misplaced, "warnings": [several, rare]}
    body = json.dumps(ENTRIES | answer).encode()
    with Client(peer(answering(body)).url) as client:
        text = planner.call(client, "find_out_of_place", {"objects": ["pan"]})
    assert text.split(". ") == [
        "These are probably objects of several rooms (bar: pan; gym: cat): ask about each room",
        "Out of place: toilet (0.97; usually with sink, shower)",
        "In a wrong place: pan in the air (>0.99)",
        "Probably wrong detections: ghost (0.90)",
        "Perhaps wrong, but no alarm: mug (0.30), mug on top of bed (0.12)",
        "Not judged, as it may be anywhere or I know it too little: odd, cat",
        "All else fits (each at most 0.04).",
    ]


def test_places_that_count_for_nothing_are_named(scene: Client) -> None:
    objects = ["bed", "desk", {"label": "lamp", "position": [1, 0, 1]}]
    for things, stated in ((objects[:2], ["desk on the floor", "desk beside bed"]), (objects, [])):
        relations = [*stated, "desk on bed"]
        call = {"objects": things, "relations": relations}
        answer = planner.call(scene, "find_out_of_place", call)
        left_out = ", ".join(f'"{one}"' for one in stated) or '"desk on-top bed"'
        assert answer.startswith(f"I left out {left_out} (I use relations between listed objects")
    answer = planner.call(scene, "imagine_room", {"room_type": "bedroom", "objects": ["pole"]})
    assert answer.startswith('I left out "pole" (the kind of the room decides).')


def test_positions_give_relations_and_places(scene: Client, peer: Any) -> None:
    desk = {"label": "desk", "position": [2, 0, 0.4], "size": [0.7, 1.4, 0.8]}
    lamp = {"label": "lamp", "position": [2, 0, 1.0], "size": [0.2, 0.2, 0.4]}
    answer = planner.call(scene, "relate_objects", {"objects": [desk, lamp]})
    assert "Known: lamp on top of desk" in answer
    offset = {"mean": {"x": 0.1, "y": -0.0, "z": 0.456}, "std": {"x": 0, "y": 0, "z": 0}}
    place = {"relation": "on-top", "object": "desk", "probability": 0.9}
    entry = {"label": "mug", "probability": 0.6, "log_odds": 0.4}
    entry["placements"] = [place | {"offset": offset | {"scenes": 1}}]
    body = json.dumps(ENTRIES | {"missing": [entry]}).encode()
    with Client(peer(answering(body)).url) as client:
        answer = planner.call(client, "suggest_missing", {"objects": [desk]})
    place = "on top of desk, at its centre + [0.1, 0.0, 0.46] m"
    assert answer == f"Probably also there: mug (0.60; {place})."


def wait(connection: socket.socket) -> None:
    """Read all that a client sends, and never answer."""
    while connection.recv(65536):
        pass


@pytest.mark.parametrize(
    ("behave", "sentence"),
    [
        (None, "The scene service does not answer: start it, or correct its address (http://"),
        (wait, "The scene service took too long: ask again, or about fewer objects."),
        (answering(b"{}", b"401 No"), "The scene service wants another API key: set SCENE_API_KEY"),
        (answering(b"{}", b"503 No"), "The scene service is busy or not ready: ask again in some"),
        (answering(b"{}", b"500 No"), "The scene service refused the question: "),
    ],
)
def test_an_error_is_one_sentence_with_its_remedy(peer: Any, behave: Any, sentence: str) -> None:
    url = "http://127.0.0.1:9" if behave is None else peer(behave).url
    client = Client(url, timeout=0.5, retries=0)
    with client, pytest.raises(planner.ToolError) as failed:
        planner.call(client, "identify_room", {"objects": ["bed"]})
    assert str(failed.value).startswith(sentence)


@pytest.mark.parametrize(
    ("name", "arguments", "sentence"),
    [
        ("sing", {}, "Correct the arguments: no tool sing; the tools are find_out_of_place, "),
        ("imagine_room", {}, "Correct the arguments: give `room_type`, or else `objects`."),
        ("imagine_room", {"room_type": "zxqvw"}, 'Use another word: "zxqvw": the model does not'),
        ("locate_object", {"thing": "zxqvw", "rooms": HOME}, 'Use another word: "zxqvw": the mod'),
        (
            "relate_objects",
            {"objects": ["bed"], "relations": ["lamp over bed"]},
            "Correct the arguments: #/relations/0: must be a subject, a relation and an object",
        ),
    ],
)
def test_wrong_arguments_are_one_sentence(
    scene: Client, name: str, arguments: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(planner.ToolError) as failed:
        planner.call(scene, name, arguments)
    assert str(failed.value).startswith(sentence)
    assert "\n" not in str(failed.value)


@pytest.mark.parametrize(
    ("text", "triple"),
    [
        ("garbage bin left bed", ("garbage bin", "left", "bed")),
        ("the lamp is on top of the side table", ("lamp", "on-top", "side table")),
        ("front door in front of desk", ("front door", "front", "desk")),
        ("milk in fridge", ("milk", "inside", "fridge")),
    ],
)
def test_relations_in_words(text: str, triple: tuple[str, str, str]) -> None:
    assert tuple(phrases.relation(text).values()) == triple


# ------------------------------------------------------------------------------------ schemas


def parts(schema: Any) -> Iterator[dict[str, Any]]:
    """Yield a schema and the schemas in it."""
    if isinstance(schema, dict):
        yield schema
        for value in schema.values():
            yield from parts(value)
    elif isinstance(schema, list):
        for value in schema:
            yield from parts(value)


@pytest.mark.parametrize(
    ("vendor", "keys", "name", "parameters"),
    [
        ("openai", ["function"], "name", "parameters"),
        ("anthropic", [], "name", "input_schema"),
        ("langchain", [], "title", None),
    ],
)
def test_schemas_follow_the_rules_of_vendors(
    vendor: str, keys: list[str], name: str, parameters: str | None
) -> None:
    done = CliRunner().invoke(app, ["mcp", "--schemas", vendor])
    tools = json.loads(done.stdout)
    assert len(tools) == len(CALLS)
    for tool, (expected, arguments, _) in zip(tools, CALLS, strict=True):
        assert len(json.dumps(tool)) < 2000
        described = tool
        for key in keys:
            described = described[key]
        assert described[name] == expected
        assert re.fullmatch("[a-zA-Z0-9_-]{1,64}", expected)
        assert 50 < len(described["description"]) < 1024
        schema = described if parameters is None else described[parameters]
        assert schema["type"] == "object"
        jsonschema.Draft202012Validator.check_schema(schema)
        jsonschema.validate(arguments, schema)
        for part in parts(schema):
            assert part.get("type") != "array" or "items" in part
            assert "$ref" not in part  # few clients resolve references
        assert all("\n" not in one["description"] for one in schema["properties"].values())
    assert [tool.get("type") for tool in tools] == [
        {"openai": "function", "anthropic": None, "langchain": "object"}[vendor]
    ] * len(tools)


def test_optional_arguments_may_be_null(scene: Client) -> None:
    # Some language models fill in all arguments.
    arguments = {"objects": ["bed", "desk"], "relations": None, "room_type": None}
    plain = planner.call(scene, "find_out_of_place", {"objects": ["bed", "desk"]})
    assert planner.call(scene, "find_out_of_place", arguments) == plain


# ------------------------------------------------------------------------------------ the command

WITHOUT_SDK = """
import sys
sys.modules["mcp"] = sys.modules["uvicorn"] = None  # importing them fails
from scene_client.command import app
app()
"""


def test_without_the_sdk_one_line_names_the_extra() -> None:
    program = (sys.executable, "-c", WITHOUT_SDK)
    assert "mcp" in run_program(*program, "--help").stdout
    assert json.loads(run_program(*program, "mcp", "--schemas", "openai").stdout)
    done = run_program(*program, "mcp", status=2)
    assert done.stderr.strip().endswith("pip install 'scene-client[mcp]'")
    assert len(done.stderr.splitlines()) == 1


def test_conventions_and_ports_in_use_are_refused(peer: Any) -> None:
    done = CliRunner().invoke(app, ["mcp", "--units", "cm"])
    assert (done.exit_code, len(done.stderr.splitlines())) == (2, 1)
    port = peer(say_nothing).url.rpartition(":")[2]
    done = CliRunner().invoke(app, ["mcp", "--http", port])
    assert (done.exit_code, len(done.stderr.splitlines())) == (2, 1)
    assert "in use" in done.stderr
