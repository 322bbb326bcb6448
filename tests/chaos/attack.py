"""Sending hostile requests and judging the answers."""

import http.client
import json
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

from app.errors import ERRORS
from scene_client.schemas import Problem
from tests.chaos.corpus import MARKER, NUMBER, Hostile

_INPUT = (MARKER, json.dumps(MARKER)[1:-1], MARKER.split()[0], NUMBER)
_LEAKS = (*_INPUT, "Traceback", "site-packages", ".py", str(Path.cwd()))


@dataclass
class Report:
    """The statuses of the answers, and a text for each answer that is not as it must be."""

    statuses: Counter[int] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)


def faults_of_problem(document: Any, status: int) -> list[str]:
    """Return what is wrong with a problem document."""
    try:
        Problem.model_validate(document, extra="forbid")
    except ValueError as error:
        return [f"does not fit the schema: {error}"]
    faults = []
    kind = ERRORS.get(document["type"].removeprefix("/problems/"))
    if kind is None or not kind.status == document["status"] == status:
        faults.append(f"status {status} with type {document['type']}, {document['status']}")
    # A problem repeats only a request id of the right form.
    text = json.dumps(document, ensure_ascii=False).replace(document["request_id"], "")
    return faults + [f"repeats or leaks {leak!r}: {text}" for leak in _LEAKS if leak in text]


def faults_of_answer(status: int, headers: Mapping[str, str], body: bytes) -> list[str]:
    """Return what is wrong with the answer to any request."""
    if status >= 500:
        return [f"status {status}: {body[:300]!r}"]
    kind = headers.get("content-type", "")
    if status < 400:
        results = json.loads(body).get("results", ()) if kind.startswith("application/json") else ()
        failed = (entry for entry in results if entry["status"] != 200)
        problems = (faults_of_problem(entry["problem"], entry["status"]) for entry in failed)
        return [*chain.from_iterable(problems)]
    if kind != "application/problem+json":
        return [f"status {status} has the media type {kind}"]
    document = json.loads(body)
    faults = faults_of_problem(document, status)
    if document.get("request_id") != headers.get("x-request-id"):
        faults.append("request id in the body and in the head differ")
    return faults


def attack(port: int, requests: Iterable[Hostile]) -> Report:
    """Send requests one after another on one connection, as long as it lasts."""
    report = Report()
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    headers = {"Content-Type": "application/json"}
    for request in requests:
        # The service may refuse a request before all of it was sent, and still answer.
        with suppress(BrokenPipeError, ConnectionResetError):
            connection.request(request.method, request.path, request.body, headers)
        try:
            response = connection.getresponse()
            body = response.read()
        except (http.client.HTTPException, OSError) as error:
            report.faults.append(f"{request.name}: no answer: {error!r}")
            connection.close()
            continue
        report.statuses[response.status] += 1
        fields = {name.lower(): value for name, value in response.getheaders()}
        faults = faults_of_answer(response.status, fields, body)
        if response.status not in request.expected:
            faults.append(f"status {response.status}, not one of {sorted(request.expected)}")
        report.faults += [f"{request.name}: {fault}" for fault in faults]
    connection.close()
    return report
