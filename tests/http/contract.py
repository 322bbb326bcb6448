"""The OpenAPI document as a generator of requests, and what its answers are checked for."""

from __future__ import annotations

import json
from typing import Any

import requests
import schemathesis
from pydantic import BaseModel, ValidationError

from app.main import create_app
from app.serving.questions import QUESTIONS
from app.settings import Settings
from scene_client import schemas
from tests.conftest import REPOSITORY
from tests.services import ADMIN_KEY, LiveService

_FORMS: dict[str, type[BaseModel]] = {
    **{f"/{question.name}": question.request for question in QUESTIONS},
    "/models/aliases/{alias}": schemas.AliasRequest,
}
_UNKNOWN_HEADER = "x-schemathesis-unknown-property"
# JSON Schema has no words for them; descriptions and messages say what is meant.
_BEYOND_SCHEMAS = {"plain_text", "unit_quaternion"}


def documented(examples: int) -> Any:
    """The document, from which tests are made before there is a service.

    It does not depend on the store.

    Args:
        examples: how many requests of each kind are drawn for an operation, beside those that go
            through its schema place by place.
    """
    positive = ["2xx", "3xx", "401", "403", "404", "409", "429", "5xx"]
    negative = ["400", "401", "404", "405", "413", "415", "422"]
    return schemathesis.openapi.from_dict(
        create_app(Settings(store=REPOSITORY)).openapi(),
        config=schemathesis.Config.from_dict(
            {
                "seed": 1,
                "generation": {"deterministic": True, "database": "none", "max-examples": examples},
                # No schema knows a model's vocabulary, or which objects a scene has: a request of
                # the right form may still make no sense. `form_is_as_documented` tells them apart.
                # A deadline of two milliseconds, which the header allows, may pass.
                "checks": {
                    "positive_data_acceptance": {"expected-statuses": [*positive, "422"]},
                    "not_a_server_error": {"expected-statuses": ["2xx", "3xx", "4xx", "504"]},
                },
                # A bad scene spoils its own entry of a batch, whose status is 200 all the same:
                # `bad_scenes_have_problems` looks into it.
                "operations": [
                    {
                        "include-path-regex": "/batch$",
                        "checks": {
                            "negative_data_rejection": {"expected-statuses": [*negative, "200"]}
                        },
                    }
                ],
            }
        ),
    )


def form_is_as_documented(_: Any, response: Any, case: Any) -> None:
    """What the document allows is refused for its sense alone."""
    if response.status_code != 422 or not case.meta.generation.mode.is_positive:
        return
    form = _FORMS[case.operation.path]
    try:
        form.model_validate_json(response.request.body)
    except ValidationError as error:
        faults = [
            fault
            for fault in error.errors(include_url=False, include_context=False)
            if fault["type"] not in _BEYOND_SCHEMAS and not _is_whole(fault)
        ]
        assert not faults, faults


def _is_whole(fault: Any) -> bool:
    """1.0 is an integer to JSON Schema, and no count to the service."""
    return fault["type"] == "int_type" and isinstance(fault["input"], float)


def bad_scenes_have_problems(_: Any, response: Any, case: Any) -> None:
    """A batch that violates its schema has an entry that says so."""
    if response.status_code != 200 or not case.operation.path.endswith("/batch"):
        return
    results = json.loads(response.content)["results"]
    for entry in results:
        assert entry["status"] in {200, 404, 422, 504}
        assert ("problem" in entry) == (entry["status"] != 200)
    if case.meta.generation.mode.is_negative:
        assert {entry["status"] for entry in results} != {200}


def call(case: schemathesis.Case, service: LiveService, session: requests.Session) -> None:
    """Send one request and check the answer with every check there is."""
    if _UNKNOWN_HEADER in (case.headers or {}):
        return  # no violation: fields that are not known are to be ignored (RFC 9110, section 5.1)
    case.call_and_validate(
        f"http://127.0.0.1:{service.port}",
        session,
        # Given here, it is taken for a valid key: checks take it away, and put others in its place.
        {"X-Admin-Key": ADMIN_KEY},
        additional_checks=[form_is_as_documented, bad_scenes_have_problems],
    )
