"""Record the answers of a running service, and compare the answers of another version with them.

    python -m scripts.corpus record http://127.0.0.1:8000 answers.jsonl.gz
    python -m scripts.corpus compare http://127.0.0.1:8001 answers.jsonl.gz

Both services must serve the `model_store` of the repository. `compare` sends the recorded requests
again. Two answers are equal if their status, problem type and fields are equal. Numbers may differ
by 1e-5. Entries of a list that have equal probabilities may change their order, and may be missing
at the end of the list. Answers of `/generate` are random: only their fixed fields must be equal. A
test of two proportions also compares how often each class occurs in many generated scenes. Requests
for models that the service no longer has are skipped.
"""

from __future__ import annotations

import argparse
import base64
import gzip
import hashlib
import json
import math
import random
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import httpx

from tests.chaos import corpus as hostile

TOLERANCE: Final = 1e-5
SEED: Final = 20261123
QUESTIONS: Final = ("relations", "missing", "outliers", "rooms")
MODELS: Final = (
    "default", "places-triway", "places-rbm", "places-triway@4.5.1",
)  # fmt: skip
RELATIONS: Final = (
    *("left", "right", "front", "behind", "on-top"),
    *("under", "above", "below", "inside", "contains"),
)
HEADERS: Final = ("content-type", "retry-after", "www-authenticate", "allow", "location")
NONSENSE: Final[tuple[dict[str, Json], ...]] = (
    {"objects": [f"nonsuch {k}" for k in range(256)]},
    {"objects": [f"nonsuch {k}" for k in range(256)], "unknown_labels": "ignore"},
    {"objects": ["bed"] * 257},
    {"objects": [{"id": "a", "label": "bed"}] * 2},
    {"objects": ["bed"], "model": "../../etc/passwd"},
    {"objects": ["bed", "lamp"], "relations": [["bed", "left", "lamp"], ["bed", "right", "lamp"]]},
    {"objects": ["bed", "lamp"], "relations": [["bed", "front", "bed"]]},
    {"objects": ["bed", "lamp"], "relations": [["nobody", "left", "nobody"]] * 1000},
    {"objects": ["bed", "lamp"], "relations_complete": True},
    {"objects": [{"label": "bed", "position": [1e8, -1e8, 1e8], "size": [5e-324, 1e4, 5e-324]}]},
)
"""Requests of the right form that make no sense."""
# Deadline of each request. It is long, so that requests also finish on a busy machine.
PATIENCE: Final = {"x-request-timeout-ms": "60000"}
# Fields that are not compared, because they differ between answers or processes.
VOLATILE: Final = frozenset({"request_id", "instance", "session", "seed"})
# Fields with lists that describe the scene of the request, not the answer.
NOTES: Final = frozenset({"ignored", "mapped", "warnings"})
# Maximum probability that any class share in `shares` is reported as different by chance.
FAILURE: Final = 1e-3

Json = Any


# ------------------------------------------------------------------------------------ requests


class Scenes:
    """Generator of random scenes for one model.

    Args:
        rng: random generator.
        labels: labels that the model knows.
        rooms: room types that the model knows.
        likely: object lists of scenes that the model generated. About 60 % of the random scenes
            start with one of these lists.
    """

    def __init__(
        self, rng: random.Random, labels: list[str], rooms: list[str], likely: list[list[str]]
    ) -> None:
        self.rng, self.labels, self.rooms, self.likely = rng, labels, rooms, likely

    def classes(self) -> list[str]:
        """Return 1 to 24 random labels. Labels can occur more than once."""
        rng = self.rng
        labels = list(rng.choice(self.likely)) if rng.random() < 0.6 else []
        labels += rng.sample(self.labels, rng.choice([0, 1, 1, 2, 4, 12]))
        labels = labels or [rng.choice(self.labels)]
        if rng.random() < 0.2:
            labels += rng.choices(labels, k=2)
        rng.shuffle(labels)
        return labels[:24]

    def scene(self) -> dict[str, Json]:
        """Return random values for the request fields that all questions have."""
        rng, labels = self.rng, self.classes()
        body: dict[str, Json] = {"objects": labels}
        form = rng.random()
        if form < 0.35:
            body["objects"] = [self.detection(k, label) for k, label in enumerate(labels)]
            body["frame_id"] = rng.choice(["base_link", "map", "camera_optical_frame", "odom"])
            if rng.random() < 0.4:
                body["viewpoint"] = {k: round(rng.uniform(-3, 3), 2) for k in ("x", "y", "yaw")}
        elif form < 0.65 and len(set(labels)) > 1:
            labels = list(dict.fromkeys(labels))
            body["objects"] = labels
            body["relations"] = self.relations(labels)
            body["relations_complete"] = rng.random() < 0.2
        elif form < 0.75:
            body["objects"] = [
                {"label": label, "confidence": round(rng.uniform(0.05, 1), 2)} for label in labels
            ]
        if self.rooms and rng.random() < 0.4:
            body["room_type"] = rng.choice(self.rooms)
        if rng.random() < 0.1:
            body["stamp"] = {"sec": rng.randrange(10**9), "nanosec": rng.randrange(10**9)}
        if rng.random() < 0.25:
            body["unknown_labels"] = rng.choice(["error", "ignore", "nearest", "nearest-or-ignore"])
            word = rng.choice(self.labels)
            wrong = rng.choice([word + "s", word[1:], word[:-1] + "x", "blue " + word, "zzxqv"])
            body["objects"] = [*body["objects"], wrong]
        return body

    def detection(self, number: int, label: str) -> dict[str, Json]:
        rng = self.rng
        detection: dict[str, Json] = {"id": f"{label[:20]}#{number}", "label": label}
        if rng.random() < 0.95:
            far = 3000.0 if rng.random() < 0.01 else 3.0
            detection["position"] = {
                "x": round(rng.uniform(0, far), 3), "y": round(rng.uniform(-far, far), 3),
                "z": round(rng.uniform(0, 1.5), 3),
            }  # fmt: skip
        if rng.random() < 0.6:
            detection["size"] = {k: round(rng.uniform(0.1, 1.5), 3) for k in "xyz"}
        if rng.random() < 0.3:
            angle = rng.uniform(-math.pi, math.pi)
            detection["orientation"] = {
                "x": 0.0,
                "y": 0.0,
                "z": math.sin(angle),
                "w": math.cos(angle),
            }
        if rng.random() < 0.3:
            detection["confidence"] = round(rng.uniform(0.05, 1), 2)
        return detection

    def relations(self, labels: list[str]) -> list[dict[str, str]]:
        rng = self.rng
        pairs = [(a, b) for k, a in enumerate(labels) for b in labels[k + 1 :]]
        return [
            {"subject": a, "relation": rng.choice(RELATIONS), "object": b}
            for a, b in rng.sample(pairs, min(len(pairs), rng.choice([1, 2, 5, 15])))
        ]

    def options(self, question: str, body: dict[str, Json]) -> dict[str, Json]:
        """Return random values for the request fields that only the given question has."""
        rng = self.rng
        names = [o if isinstance(o, str) else o.get("id", o["label"]) for o in body["objects"]]
        rooms = min(len(self.rooms), 4)

        def drawn(**choices: list[str]) -> dict[str, str]:
            return {name: rng.choice(values) for name, values in choices.items()}

        # The chance of each field, and a function that draws its value.
        fields: dict[str, dict[str, tuple[float, Callable[[], Json]]]] = {
            "relations": {
                "include_opposites": (0.3, lambda: True),
                "min_probability": (0.3, lambda: rng.choice([0.01, 0.2, 0.9])),
                "pairs": (
                    0.3,
                    lambda: [drawn(subject=names, object=names) for _ in range(rng.choice([1, 4]))],
                ),
            },
            "missing": {
                "coverage": (0.4, lambda: rng.choice([0.0, 0.25, 0.5, 0.9, 1.0])),
                "candidates": (0.3, lambda: rng.sample(self.labels, 5)),
                "at": (0.4, lambda: drawn(relation=[*RELATIONS], object=names)),
            },
            "outliers": {
                "sensitivity": (0.5, lambda: rng.choice(["low", "medium", "high"])),
                "threshold": (0.2, lambda: rng.choice([0.0, 0.3, 0.7, 1.0])),
            },
            "rooms": {"candidates": (0.4 * bool(rooms), lambda: rng.sample(self.rooms, rooms))},
        }
        top_k = {"top_k": (0.5, lambda: rng.choice([1, 3, 10, 50]))}
        chosen = fields[question] | (top_k if question != "outliers" else {})
        return {name: draw() for name, (chance, draw) in chosen.items() if rng.random() < chance}


def post(path: str, body: Json, **headers: str) -> dict[str, Json]:
    """Return a POST request in the format of the record file."""
    return {
        "method": "POST", "path": path,
        "headers": {"content-type": "application/json", **PATIENCE, **headers},
        "body": base64.b64encode(json.dumps(body).encode()).decode(),
    }  # fmt: skip


def questions(client: httpx.Client, rng: random.Random) -> Iterator[dict[str, Json]]:
    """Generate requests with questions about scenes, for every model, single and in batches."""
    for model in MODELS:
        words = client.get(f"/models/{model}/vocabulary").raise_for_status().json()
        drawn = client.post("/generate", json={"model": model, "count": 64, "seed": 1}).json()
        likely = [scene["objects"] for scene in drawn["scenes"] if scene["objects"]]
        labels = [entry["label"] for entry in words["objects"]]
        scenes = Scenes(rng, labels, words["room_types"], likely)
        count = 60 if model == "places-triway@4.5.1" else 210
        for k in range(count):
            question = QUESTIONS[k % len(QUESTIONS)]
            body = scenes.scene() | {"model": model}
            if model == "default":
                del body["model"]
            yield post(f"/{question}", body | scenes.options(question, body))
        for question in QUESTIONS:
            for size in (1, 4, 16):
                batch: list[Json] = [scenes.scene() | {"model": model} for _ in range(size)]
                batch[-1] |= scenes.options(question, batch[-1])
                yield post(f"/{question}/batch", {"scenes": [*batch, {"objects": [""]}]})
        for _ in range(12):
            body = scenes.scene() | {"model": model, "count": 3, "seed": 7, "steps": 20}
            yield post("/generate", body)


def drawn(client: httpx.Client) -> Iterator[dict[str, Json]]:
    """Generate requests to `/generate` whose answers are compared by the frequency of classes."""
    for model in MODELS[1:]:
        words = client.get(f"/models/{model}/vocabulary").json()
        rooms = [room for room in ("kitchen", "bedroom", "bathroom") if room in words["room_types"]]
        evidence: list[dict[str, Json]] = [
            {},
            *({"room_type": room} for room in rooms),
            {"objects": ["table"]},
        ]
        for body in evidence:
            yield post("/generate", {**body, "model": model, "count": 64, "seed": 11})


def errors() -> Iterator[dict[str, Json]]:
    """Generate invalid requests of every kind."""
    for entry in list(hostile.requests())[::23]:
        if len(entry.body) > 200_000:
            continue
        headers = {"content-type": "application/json"}
        yield {
            "method": entry.method, "path": entry.path, "headers": headers,
            "body": base64.b64encode(entry.body).decode(),
        }  # fmt: skip
    for question in (*QUESTIONS, "generate"):
        for body in NONSENSE:
            yield post(f"/{question}", body)
        for kind in ("", "text/plain", "application/json; charset=latin-1"):
            yield post(f"/{question}", {"objects": ["bed"]}, **{"content-type": kind})
        for method in ("GET", "PUT", "DELETE", "PROPFIND"):
            yield post(f"/{question}", {}) | {"method": method}
    for deadline in ("0", "-1", "x", "600001", "1.5", "600000"):
        yield post("/missing", {"objects": ["bed"]}, **{"x-request-timeout-ms": deadline})
    yield post("/missing", {"objects": ["bed"]}, **{"x-request-id": "corpus-1"})


def pages(client: httpx.Client) -> Iterator[dict[str, Json]]:
    """Generate all GET requests."""
    listed = client.get("/models").json()
    paths = [
        "/", "/docs", "/redoc", "/openapi.json", "/models", "/health/live", "/health/ready",
        "/problems", "/nowhere", "/models/none", "/models/none/vocabulary",
    ]  # fmt: skip
    listing = client.get("/problems").text.split('"/problems/')[1:]
    paths += ["/problems/" + entry.partition('"')[0] for entry in listing]
    names = [model["name"] for model in listed["models"]]
    for name in [*names, "default"]:
        paths += [f"/models/{name}", f"/models/{name}/vocabulary"]
    for model in listed["models"]:
        paths += [f"/models/{model['name']}/versions/{v['version']}" for v in model["versions"]]
        paths.append(f"/models/{model['name']}/versions/9.9.9")
    for path in paths:
        yield {"method": "GET", "path": path, "headers": {}, "body": ""}


# ------------------------------------------------------------------------------------- asking


def ask(client: httpx.Client, request: dict[str, Json]) -> dict[str, Json]:
    """Send a request, and return the answer in the format of the record file."""
    body = base64.b64decode(request["body"])
    answer = client.request(
        request["method"], request["path"], headers=request["headers"], content=body
    )
    record: dict[str, Json] = {
        "status": answer.status_code,
        "headers": {k: _in_order(answer.headers[k]) for k in HEADERS if k in answer.headers},
    }
    if "json" in answer.headers.get("content-type", ""):
        record["json"] = answer.json()
    else:
        record["sha256"] = hashlib.sha256(answer.content).hexdigest()
    return record


def _in_order(header: str) -> str:
    """Sort the values of a header such as `Allow`, because their order has no meaning."""
    return ", ".join(sorted(header.split(", ")))


# ---------------------------------------------------------------------------------- comparing


def differences(old: Json, new: Json, at: str = "") -> Iterator[str]:
    """Generate a description of each difference between two JSON values.

    Args:
        at: path of the values in the answer.
    """
    if isinstance(old, bool) or isinstance(new, bool) or old is None or isinstance(old, str):
        if old != new or type(old) is not type(new):
            yield f"{at}: {old!r:.80} → {new!r:.80}"
    elif isinstance(old, int | float) and isinstance(new, int | float):
        if not math.isclose(old, new, rel_tol=TOLERANCE, abs_tol=TOLERANCE):
            yield f"{at}: {old!r} → {new!r}"
    elif isinstance(old, dict) and isinstance(new, dict):
        for name in sorted(old.keys() | new.keys()):
            if name in VOLATILE:
                continue
            if name not in old or name not in new:
                yield f"{at}/{name}: {'only before' if name in old else 'only now'}"
            else:
                yield from differences(old[name], new[name], f"{at}/{name}")
    elif isinstance(old, list) and isinstance(new, list):
        yield from _lists(old, new, at)
    else:
        yield f"{at}: {old!r:.80} → {new!r:.80}"


def _lists(old: list[Json], new: list[Json], at: str) -> Iterator[str]:
    scored = [e for e in (*old, *new) if isinstance(e, dict) and _score(e) is not None]
    if not scored or len(scored) < len(old) + len(new):
        if len(old) != len(new):
            yield f"{at}: {len(old)} entries before, {len(new)} now"
        for k, (a, b) in enumerate(zip(old, new, strict=False)):
            yield from differences(a, b, f"{at}/{k}")
        return
    before, after = ({_texts(e): e for e in entries} for entries in (old, new))
    for name, entry in before.items():
        if name in after:
            yield from differences(entry, after[name], f"{at}/{name}")
    # A list may end with another entry of equal probability.
    for mine, other, when in ((old, after, "before"), (new, before, "now")):
        last = abs(_score(mine[-1]) or 0.0) if mine else 0.0
        for entry in mine:
            if _texts(entry) not in other and abs(abs(_score(entry) or 0.0) - last) > TOLERANCE:
                yield f"{at}/{_texts(entry)}: only {when}"
    ranks = [abs(_score(before[_texts(e)]) or 0.0) for e in new if _texts(e) in before]
    falling = old and abs(_score(old[0]) or 0.0) >= abs(_score(old[-1]) or 0.0)
    steps = pairwise(ranks)
    if falling and any(b > a + TOLERANCE for a, b in steps) and not _is_ordered(old, before, new):
        yield f"{at}: the order differs"


def _is_ordered(old: list[Json], before: dict[Json, Json], new: list[Json]) -> bool:
    """Return True if the entries that both lists contain have the same order.

    Some lists are not sorted by probability.
    """
    common = [_texts(e) for e in new if _texts(e) in before]
    return [_texts(e) for e in old if _texts(e) in set(common)] == common


def _score(entry: dict[str, Json]) -> float | None:
    return entry.get("probability", entry.get("log_odds_change"))


def _texts(entry: dict[str, Json]) -> Json:
    return tuple(str(v) for v in entry.values() if isinstance(v, str))


def shares(old: Json, new: Json, tests: int) -> Iterator[str]:
    """Generate a description of each class whose frequency differs between two answers.

    Each class is tested by a test of two proportions with Bonferroni correction.

    Args:
        old: recorded answer of `/generate`.
        new: new answer of `/generate`.
        tests: total number of tests, for the correction.
    """
    a, b = (
        Counter(label for scene in answer["json"]["scenes"] for label in set(scene["objects"]))
        for answer in (old, new)
    )
    n, m = len(old["json"]["scenes"]), len(new["json"]["scenes"])
    # Threshold for |z|: a standard normal z exceeds it with a probability below FAILURE / tests.
    limit = math.sqrt(2 * math.log(tests / FAILURE))
    for label in a.keys() | b.keys():
        p = (a[label] + b[label] + 1) / (n + m + 2)
        z = (a[label] / n - b[label] / m) / math.sqrt(p * (1 - p) * (1 / n + 1 / m))
        if abs(z) > limit:
            yield f"{label}: in {a[label]} of {n} scenes → {b[label]} of {m}"


def undrawn(answer: dict[str, Json]) -> dict[str, Json]:
    """Return an answer of `/generate` with the number of scenes in place of the scenes."""
    if answer["status"] != 200:
        return answer
    return answer | {"json": answer["json"] | {"scenes": len(answer["json"]["scenes"])}}


# ----------------------------------------------------------------------------------- commands


def record(url: str, file: Path) -> int:
    """Send all requests, and write the requests and answers to a file. Return exit status 0."""
    rng = random.Random(SEED)
    counts: Counter[str] = Counter()
    with httpx.Client(base_url=url, timeout=60) as client, gzip.open(file, "wt") as out:
        for kind, requests in (
            ("question", questions(client, rng)), ("drawn", drawn(client)), ("error", errors()),
            ("page", pages(client)),
        ):  # fmt: skip
            for request in requests:
                answer = ask(client, request)
                out.write(json.dumps({"kind": kind, "request": request, "answer": answer}) + "\n")
                counts[kind] += 1
    sys.stdout.write(f"{sum(counts.values())} recorded: {dict(counts)}\n")
    return 0


def lost_model(old: Json, new: Json) -> bool:
    """Return True if the recorded service had the model of a request, and this one lacks it."""
    kind = str(new.get("json", {}).get("type", "")) if new["status"] == 404 else ""
    return old["status"] != 404 and kind.endswith(("/model-not-found", "/model-replaced"))


def compare(url: str, file: Path) -> int:
    """Send all recorded requests again. Return exit status 1 if an answer differs, else 0."""
    with gzip.open(file, "rt") as lines:
        entries = [json.loads(line) for line in lines]
    tests = 400 * sum(entry["kind"] == "drawn" for entry in entries)
    differing = skipped = 0
    with httpx.Client(base_url=url, timeout=60) as client:
        for entry in entries:
            request, old = entry["request"], entry["answer"]
            new = ask(client, request)
            if lost_model(old, new):
                skipped += 1
                continue
            if entry["kind"] == "drawn" and old["status"] == new["status"] == 200:
                changes = list(shares(old, new, tests))
            elif request["path"] == "/generate":
                changes = list(differences(undrawn(old), undrawn(new)))
            else:
                changes = list(differences(old, new))
            if changes:
                differing += 1
                body = base64.b64decode(request["body"])[:300].decode("latin-1")
                sys.stdout.write(f"{request['method']} {request['path']} {body}\n")
                sys.stdout.writelines(f"    {line}\n" for line in changes[:6])
    sys.stdout.write(f"{differing} of {len(entries) - skipped} answers differ\n")
    if skipped:
        sys.stdout.write(f"{skipped} requests skipped: the service no longer has their model\n")
    return int(differing > 0)


def main() -> int:
    """Run the command that the command line names, and return its exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("command", choices=("record", "compare"))
    parser.add_argument("url")
    parser.add_argument("file", type=Path)
    options = parser.parse_args()
    httpx.get(f"{options.url}/health/ready").raise_for_status()
    act = record if options.command == "record" else compare
    return act(options.url, options.file)


if __name__ == "__main__":
    sys.exit(main())
