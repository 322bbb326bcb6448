"""Generate requests from the OpenAPI document, and check the answers."""

from __future__ import annotations

import json
from typing import Any

import requests
import schemathesis
from pydantic import BaseModel, ValidationError

from app.main import create_app
from app.questions import QUESTIONS
from app.settings import Settings
from scene_client import schemas
from tests.conftest import REPOSITORY
from tests.services import ADMIN_KEY, LiveService

_FORMS: dict[str, type[BaseModel]] = {
    **{f"/{question.name}": question.request for question in QUESTIONS},
    "/models/aliases/{alias}": schemas.AliasRequest,
}
_UNKNOWN_HEADER = "x-schemathesis-unknown-property"
# Types of validation errors for constraints that JSON Schema cannot express.
_BEYOND_SCHEMAS = {"plain_text", "unit_quaternion"}


def documented(examples: int) -> Any:
    """The OpenAPI document as a schemathesis schema.

    It does not depend on the store, so tests can be collected before the service starts.

    Args:
        examples: number of random requests of each kind for an operation, besides the systematic
            requests for each part of its schema.
    """
    positive = ["2xx", "3xx", "401", "403", "404", "409", "429", "5xx"]
    negative = ["400", "401", "404", "405", "413", "415", "422"]
    return schemathesis.openapi.from_dict(
        create_app(Settings(store=REPOSITORY)).openapi(),
        config=schemathesis.Config.from_dict(
            {
                "seed": 1,
                "generation": {"deterministic": True, "database": "none", "max-examples": examples},
                # The schema does not contain a model's vocabulary or the ids of a scene. So a
                # request that fits the schema may get 422; `form_is_as_documented` checks the
                # reason. 504 is valid too, since a request may have a deadline of 2 ms.
                "checks": {
                    "positive_data_acceptance": {"expected-statuses": [*positive, "422"]},
                    "negative_data_rejection": {"expected-statuses": negative},
                    "not_a_server_error": {"expected-statuses": ["2xx", "3xx", "4xx", "504"]},
                },
                # A batch with an invalid scene has status 200; only the scene's entry has a
                # problem. `bad_scenes_have_problems` checks the entries.
                "operations": [
                    {
                        "include-path-regex": "/batch$",
                        "checks": {
                            "negative_data_rejection": {"expected-statuses": [*negative, "200"]}
                        },
                    },
                    # The valid key that `call` sends suffices, even beside an invalid bearer token.
                    {
                        "include-path": "/models/refresh",
                        "checks": {
                            "negative_data_rejection": {"expected-statuses": [*negative, "200"]}
                        },
                    },
                ],
            }
        ),
    )


def form_is_as_documented(_: Any, response: Any, case: Any) -> None:
    """A request that fits the schema is refused only for a reason outside the schema."""
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
    """Whether the input is a float such as 1.0, which JSON Schema accepts as an integer."""
    return fault["type"] == "int_type" and isinstance(fault["input"], float)


def bad_scenes_have_problems(_: Any, response: Any, case: Any) -> None:
    """A batch that violates its schema has an entry with a problem."""
    if response.status_code != 200 or not case.operation.path.endswith("/batch"):
        return
    results = json.loads(response.content)["results"]
    for entry in results:
        assert entry["status"] in {200, 404, 422, 504}
        assert ("problem" in entry) == (entry["status"] != 200)
    if case.meta.generation.mode.is_negative:
        assert {entry["status"] for entry in results} != {200}


def call(case: schemathesis.Case, service: LiveService, session: requests.Session) -> None:
    """Send one request and run all checks on the answer."""
    if _UNKNOWN_HEADER in (case.headers or {}):
        return  # a valid request: servers ignore unknown header fields (RFC 9110, section 5.1)
    case.call_and_validate(
        f"http://127.0.0.1:{service.port}",
        session,
        # schemathesis takes this key as valid; its checks remove the key or replace it.
        {"X-Admin-Key": ADMIN_KEY},
        additional_checks=[form_is_as_documented, bad_scenes_have_problems],
    )
