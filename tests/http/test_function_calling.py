"""The operations of the OpenAPI document as functions that a language model calls.

The rules are those that OpenAI, Anthropic and Google state for function declarations, and the
strictest of them if they differ.
"""

import re
from collections.abc import Iterator
from typing import Any

import pytest
from jsonschema import Draft202012Validator

from app.api.examples import REQUESTS
from app.main import create_app
from app.settings import Settings
from tests.conftest import REPOSITORY
from tests.http.test_documentation import inlined, operations

# The fields of Google's `Schema` (parameters of a function). Anthropic and OpenAI take all of them.
KEYWORDS = {
    *("type", "title", "description", "default", "enum", "anyOf"),
    *("properties", "required", "items", "minItems", "maxItems"),
    *("minimum", "maximum", "minLength", "maxLength"),
}
# Anthropic and OpenAI also take these. docs/clients.md tells users of Google to leave them out.
NOT_FOR_GOOGLE = {"additionalProperties", "exclusiveMinimum"}


@pytest.fixture(scope="module")
def functions() -> dict[str, dict[str, Any]]:
    document = create_app(Settings(store=REPOSITORY)).openapi()
    return {one["operationId"]: declaration(one, document) for *_, one in operations(document)}


def declaration(operation: dict[str, Any], document: dict[str, Any]) -> dict[str, Any]:
    """Return the function of an operation: the fields of its body, path and query are arguments."""
    stated = [
        one for one in inlined(operation.get("parameters", []), document) if one["in"] != "header"
    ]
    body: dict[str, Any] = {"properties": {}}
    if "requestBody" in operation:
        body = operation["requestBody"]["content"]["application/json"]["schema"]
    body = inlined(body, document)
    assert not {one["name"] for one in stated} & set(body["properties"])
    return {
        "name": operation["operationId"],
        "description": f"{operation['summary']}\n\n{operation['description']}",
        "parameters": body
        | {
            "type": "object",
            "properties": {one["name"]: one["schema"] for one in stated} | body["properties"],
            "required": [
                *(one["name"] for one in stated if one["required"]),
                *body.get("required", []),
            ],
        },
    }


def subschemas(schema: dict[str, Any], depth: int = 0) -> Iterator[tuple[dict[str, Any], int]]:
    """Yield all parts of a schema, each with the number of objects and lists around it."""
    yield schema, depth
    for part in schema.get("properties", {}).values():
        yield from subschemas(part, depth + 1)
    for part in schema.get("anyOf", []):
        yield from subschemas(part, depth)
    if "items" in schema:
        yield from subschemas(schema["items"], depth + 1)


def test_names_and_descriptions(functions: dict[str, dict[str, Any]]) -> None:
    assert {"missing", "where_batch", "show_word"} <= set(functions)
    for name, function in functions.items():
        assert re.fullmatch(r"[a-zA-Z_][a-zA-Z0-9_-]{0,63}", name)
        assert len(function["description"]) <= 1024
        for part, _ in subschemas(function["parameters"]):
            for argument in part.get("properties", {}):
                assert re.fullmatch(r"[a-zA-Z_][a-zA-Z0-9_]{0,63}", argument), (name, argument)


def test_arguments_are_one_object(functions: dict[str, dict[str, Any]]) -> None:
    for name, function in functions.items():
        arguments = function["parameters"]
        Draft202012Validator.check_schema(arguments)
        assert arguments["type"] == "object", name
        assert "anyOf" not in arguments, name


def test_all_keywords_are_supported(functions: dict[str, dict[str, Any]]) -> None:
    for name, function in functions.items():
        for part, _ in subschemas(function["parameters"]):
            assert part.keys() <= KEYWORDS | NOT_FOR_GOOGLE, name
            assert isinstance(part.get("type"), str) or "anyOf" in part, (name, part)
            assert ("items" in part) == (part.get("type") == "array"), (name, part)
            assert all(isinstance(value, str) for value in part.get("enum", [])), (name, part)


def test_arguments_are_within_the_limits_of_size(functions: dict[str, dict[str, Any]]) -> None:
    """The limits are OpenAI's."""
    for name, function in functions.items():
        parts = list(subschemas(function["parameters"]))
        names = [key for part, _ in parts for key in part.get("properties", {})]
        values = [value for part, _ in parts for value in part.get("enum", [])]
        assert max(depth for _, depth in parts) <= 10, name
        assert len(names) <= 5000, name
        assert len(values) <= 1000, name
        assert len("".join(names + values)) <= 120_000, name


def test_example_requests_are_arguments(functions: dict[str, dict[str, Any]]) -> None:
    for name in functions.keys() & REQUESTS.keys():
        validator = Draft202012Validator(functions[name]["parameters"])
        for case in REQUESTS[name].values():
            if case.problem is None:
                validator.validate(case.value)
        assert not validator.is_valid({"objects": "bed", "scenes": 1})
