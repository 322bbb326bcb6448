"""The OpenAPI document: stable operation ids, and all problems of each route."""

import json
from collections.abc import Iterable
from typing import Any, Final

from fastapi import FastAPI
from fastapi.routing import APIRoute
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from app.api import examples
from app.api.gateway import API_KEY, HEALTH, OPEN_ROUTES, TIMEOUT_HEADER
from app.api.problems import MEDIA_TYPE
from app.errors import ERRORS, Step
from app.questions.question import Example
from app.serving.runtime import Runtime
from app.settings import Settings
from scene_client.schemas import MAX_SEED, Problem

Responses = dict[int | str, dict[str, Any]]

_REFERENCE: Final = "#/components/schemas/{model}"
_LONG: Final = 130
"""Minimum length of a shared part of the document in characters of JSON."""

_KEY_SCHEMES: Final = {
    "api-key": {"type": "apiKey", "in": "header", "name": API_KEY},
    "api-key-as-bearer-token": {"type": "http", "scheme": "bearer"},
}
TAGS: Final = [
    {"name": "questions", "description": "The questions about one scene, or about a home."},
    {"name": "batches", "description": "The same questions about many scenes in one request."},
    {"name": "files", "description": "Scenes from files of detectors, tools and simulators."},
    {"name": "recording", "description": "Confirmed scenes, from which a home is learned."},
    {"name": "models", "description": "The models, their versions and their vocabularies."},
    {"name": "health", "description": "Health checks for orchestrators."},
    {"name": "monitoring", "description": "Metrics for Prometheus."},
]


def error_responses(*steps: Step) -> Responses:
    """Return the error responses of a route whose requests take these steps."""
    responses: Responses = {}
    for kind in ERRORS.values():
        if not {"route", *steps}.intersection(kind.steps):
            continue
        content = {"schema": {"$ref": _REFERENCE.format(model="Problem")}, "examples": {}}
        empty = {"description": kind.title, "content": {MEDIA_TYPE: content}}
        response = responses.setdefault(kind.status, empty)
        problem = kind(detail=f"{kind.title}.", errors=kind.example).describe(examples.REQUEST_ID)
        response["content"][MEDIA_TYPE]["examples"][kind.slug] = {
            "summary": kind.title,
            "value": problem.model_dump(mode="json", exclude_none=True),
        }
    return responses


def described(example: Example) -> dict[str, Any]:
    """Return an example request as an Example Object of OpenAPI."""
    if example.problem is None:
        return {"summary": example.summary, "value": example.value}
    kind = ERRORS[example.problem]
    return {
        "summary": f"{example.summary}: {kind.status}",
        "description": f"Refused: {kind.title} (`{kind.uri}`).",
        "value": example.value,
    }


def operation_id(route: APIRoute) -> str:
    """Return the name of the route's function. Generated clients use this name for the method."""
    return route.name


def _tidy(schema: Any) -> None:
    """Remove titles, which repeat names. Convert bounds of integers from float to int."""
    if isinstance(schema, dict):
        if isinstance(schema.get("title"), str):
            del schema["title"]
        if schema.get("type") == "integer":
            for bound in ("minimum", "maximum"):
                if bound in schema:
                    # As a float, MAX_SEED is rounded up.
                    schema[bound] = min(int(schema[bound]), MAX_SEED)
        for value in schema.values():
            _tidy(value)
    elif isinstance(schema, list):
        for value in schema:
            _tidy(value)


class DocumentedAPI(FastAPI):
    """FastAPI application whose OpenAPI document also contains examples and problems."""

    def openapi(self) -> dict[str, Any]:
        """Return FastAPI's OpenAPI document with examples and with problems as error responses."""
        if self.openapi_schema is None:
            _complete(super().openapi(), self.state.settings)
        return super().openapi()


async def show_document(http: Request) -> Response:
    """Return the OpenAPI document. Behind a proxy, it names the path of the service."""

    def build(_: object) -> Response:
        document, root = http.app.openapi(), http.scope.get("root_path")
        return JSONResponse(document | {"servers": [{"url": root}]} if root else document)

    # The first document takes 0.3 s.
    runtime: Runtime = http.app.state.runtime
    return await runtime.admission.in_worker(http.state.ticket, build)


def _complete(document: dict[str, Any], settings: Settings) -> None:
    """Add problems, examples and the API key, and state each repeated part only once."""
    schemas = document["components"]["schemas"]
    problem = Problem.model_json_schema(mode="serialization", ref_template=_REFERENCE)
    schemas |= problem.pop("$defs") | {"Problem": problem}
    for path, operations in document["paths"].items():
        for operation in operations.values():
            _complete_operation(operation, path, settings)
    schemas.pop("HTTPValidationError", None)
    schemas.pop("ValidationError", None)
    if settings.api_key is not None:
        document["components"].setdefault("securitySchemes", {}).update(_KEY_SCHEMES)
    _tidy(schemas)
    _share_parts(document)


def _share_parts(document: dict[str, Any]) -> None:
    """Move repeated responses, parameters, examples and fields to the components."""
    operations = [one for path in document["paths"].values() for one in path.values()]
    errors = [
        (".".join(response["content"][MEDIA_TYPE]["examples"]), operation["responses"], status)
        for operation in operations
        for status, response in operation["responses"].items()
        if MEDIA_TYPE in response["content"]
    ]
    parameters = [
        (parameter["name"], operation["parameters"], number)
        for operation in operations
        for number, parameter in enumerate(operation.get("parameters", ()))
    ]
    requests = [
        (name, body["examples"], name)
        for operation in operations
        if "requestBody" in operation
        for body in operation["requestBody"]["content"].values()
        for name in body["examples"]
    ]
    fields = [
        (f"{name.title().replace('_', '')}Field", schema["properties"], name)
        for schema in document["components"]["schemas"].values()
        for name in schema.get("properties", ())
    ]
    parts = {
        "responses": errors, "parameters": parameters, "examples": requests, "schemas": fields,
    }  # fmt: skip
    for kind, places in parts.items():
        _share(document["components"], kind, places)


def _share(components: dict[str, Any], kind: str, places: Iterable[tuple[str, Any, Any]]) -> None:
    """Replace long equal parts of the document by references to one component.

    A place is the name of the component, the dictionary or list with the part, and its key. If
    different parts have the same name, only the first of them becomes a component.
    """
    equal: dict[tuple[str, str], list[tuple[Any, Any]]] = {}
    for name, parent, key in places:
        equal.setdefault((name, json.dumps(parent[key])), []).append((parent, key))
    shared = components.setdefault(kind, {})
    for (name, text), parents in equal.items():
        if len(parents) > 1 and len(text) > _LONG and name not in shared:
            shared[name] = json.loads(text)
            reference = {"$ref": f"#/components/{kind}/{name}"}
            if "default" in shared[name]:
                # Redoc shows only a default beside the reference.
                reference["default"] = shared[name].pop("default")
            for parent, key in parents:
                parent[key] = reference


def _complete_operation(operation: dict[str, Any], path: str, settings: Settings) -> None:
    """Add the examples, the time limit, the API key and the problems of an operation."""
    responses, name = operation["responses"], operation["operationId"]
    (ok,) = responses["200"]["content"].values()
    ok["example"] = examples.ANSWERS[name]
    if "requestBody" in operation:
        (body,) = operation["requestBody"]["content"].values()
        body["examples"] = {key: described(case) for key, case in examples.REQUESTS[name].items()}
    if "504" in responses:
        most = settings.max_request_timeout_ms
        timeout = {
            "name": TIMEOUT_HEADER,
            "in": "header",
            "required": False,
            "description": "time limit in milliseconds; after this time, the service answers 504",
            "schema": {"type": "integer", "minimum": 1, "maximum": most},
            "examples": {"second": {"summary": "one second", "value": min(1000, most)}},
        }
        operation.setdefault("parameters", []).append(timeout)
    if "application/json" in responses.get("422", {}).get("content", {}):
        del responses["422"]  # the default of FastAPI, which the service does not answer
    if settings.api_key is not None and path not in OPEN_ROUTES:
        operation["security"] = [{scheme: []} for scheme in _KEY_SCHEMES]
        responses["401"] = error_responses("key")[401]
    if settings.accepted_hosts is not None and path not in HEALTH:
        responses["421"] = error_responses("host")[421]
