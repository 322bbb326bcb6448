"""The OpenAPI document: a live service answers generated requests as documented."""

import functools
import json
import operator
from collections.abc import Iterator
from typing import Any

import pytest
import requests
import schemathesis
from pydantic import BaseModel, ValidationError

from app.main import create_app
from app.questions import QUESTIONS
from app.settings import Settings
from scene_client import schemas
from tests.conftest import REPOSITORY
from tests.services import PATIENCE, LiveService

pytestmark = pytest.mark.system

FORMS: dict[str, type[BaseModel]] = {
    **{f"/{question.name}": question.request for question in QUESTIONS},
    "/scenes": schemas.ScenesRequest,
}
UNKNOWN_HEADER = "x-schemathesis-unknown-property"
# Types of validation errors for constraints that JSON Schema cannot express.
BEYOND_SCHEMAS = {"plain_text", "unit_quaternion", "too_many_sweeps", "content"}

POSITIVE = ["2xx", "3xx", "401", "403", "404", "409", "429", "5xx"]
NEGATIVE = ["400", "401", "404", "405", "413", "415", "422"]
CONFIGURATION: dict[str, Any] = {
    "seed": 1,
    # Random requests, in addition to systematic ones for each part of an operation's schema.
    "generation": {"deterministic": True, "database": "none", "max-examples": 5},
    # The schema does not contain a model's vocabulary or the ids of a scene. So a request that fits
    # the schema may get 422; `form_is_as_documented` checks the reason. 504 is valid too, since a
    # request may have a deadline of 2 ms.
    "checks": {
        "positive_data_acceptance": {"expected-statuses": [*POSITIVE, "422"]},
        "negative_data_rejection": {"expected-statuses": NEGATIVE},
        "not_a_server_error": {"expected-statuses": ["2xx", "3xx", "4xx", "504"]},
    },
    # A batch with an invalid scene has status 200; `bad_scenes_have_problems` checks its entries.
    "operations": [
        {
            "include-path-regex": "/batch$",
            "checks": {"negative_data_rejection": {"expected-statuses": [*NEGATIVE, "200"]}},
        }
    ],
}
# The document does not depend on the store, so it exists before the service starts. Batches differ
# only in their scenes, which have the forms of single requests.
DOCUMENT = schemathesis.openapi.from_dict(
    create_app(Settings(store=REPOSITORY)).openapi(),
    config=schemathesis.Config.from_dict(CONFIGURATION),
).exclude(path=["/relations/batch", "/outliers/batch", "/rooms/batch"])


def form_is_as_documented(_: Any, response: Any, case: Any) -> None:
    """A request that fits the schema is refused only for a reason outside the schema."""
    if response.status_code != 422 or not case.meta.generation.mode.is_positive:
        return
    try:
        FORMS[case.operation.path].model_validate_json(response.request.body)
    except ValidationError as error:
        faults = error.errors(include_url=False, include_context=False)
    else:
        return
    body = json.loads(response.request.body)
    assert {fault["type"] for fault in faults if not is_allowed(fault, body)} <= BEYOND_SCHEMAS


def is_allowed(fault: Any, body: Any) -> bool:
    """Return whether the value is valid in the schema, because of its type or its place."""
    if fault["type"] == "literal_error":
        # The schema of an array such as ["lamp", "on-top", "desk"] does not state the order.
        parent = functools.reduce(operator.getitem, fault["loc"][:-1], body)
        return isinstance(parent, list)
    # JSON Schema accepts a float such as 1.0 as an integer.
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


@pytest.fixture(scope="module")
def call(live: LiveService) -> Iterator[Any]:
    """Return a function that sends one request and runs all checks on the answer."""
    with requests.Session() as session:

        def call(case: schemathesis.Case) -> None:
            if UNKNOWN_HEADER in (case.headers or {}):
                return  # valid: servers ignore unknown header fields (RFC 9110, section 5.1)
            checks = [form_is_as_documented, bad_scenes_have_problems]
            case.call_and_validate(live.url, session, additional_checks=checks, timeout=PATIENCE)

        yield call


@DOCUMENT.parametrize()
def test_every_operation_matches_the_document(case: schemathesis.Case, call: Any) -> None:
    call(case)
