"""Metrics for Prometheus. `GET /metrics` returns them as text.

Clients cannot create label values of metrics, so the number of series stays small. The label of a
route is its template, and only served models have labels. Each replica reports its own metrics.
"""

import asyncio
import time
from functools import cache, partial
from time import monotonic
from typing import Final, Literal, get_args

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    disable_created_metrics,
    generate_latest,
)

from app.questions.answer import Fields
from app.serving.admission import Admission
from app.serving.models import DEFAULT, Key, ServedModels
from scene_client.schemas.answers import WarningCode

Outcome = Literal["success", "refused", "failed"]

_SECONDS: Final = (
    *(0.0001, 0.00025, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025),
    *(0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0),
)
_MODEL: Final = ("model", "version")
_FINDINGS: Final = (("outlier", "misplaced"), ("ignored", "guessed"), get_args(WarningCode))
_GUESSES: Final = ("spelling", "head")  # the other rules of `scene_client.schemas.Rule` are certain

# Prometheus needs no second series of each counter, because it detects restarts itself.
disable_created_metrics()  # type: ignore[no-untyped-call]


class Metrics:
    """The metrics of one application. Call the methods only on the thread of the event loop."""

    def __init__(self, admission: Admission) -> None:
        self._registry = registry = CollectorRegistry()  # a process may have several applications
        counter, gauge = partial(Counter, registry=registry), partial(Gauge, registry=registry)
        histogram = partial(Histogram, registry=registry, buckets=_SECONDS)
        self._requests = counter("scene_requests_total", "Requests answered", ("route", "outcome"))
        self._latency = histogram(
            "scene_request_duration_seconds",
            "Seconds from the first byte of the request to the last byte of the response",
            ("route",),
        )
        self._entries = counter(
            "scene_batch_entries_total", "Scenes of batch requests", ("question", "outcome")
        )
        self._queue = histogram(
            "scene_queue_duration_seconds",
            "Seconds that a scene waited before its computation",
            _MODEL,
        )
        self._compute = histogram(
            "scene_compute_duration_seconds",
            "Seconds that a model computed for one question",
            (*_MODEL, "question"),
        )
        self._objects = counter(
            "scene_objects_total", "Objects of the answered scenes", (*_MODEL, "question")
        )
        self._alarms = counter(
            "scene_alarms_total", "Outliers and misplaced relations in answers", (*_MODEL, "alarm")
        )
        self._unknown = counter(
            "scene_unknown_labels_total",
            "Labels outside the vocabulary that the service ignored or guessed",
            (*_MODEL, "reading"),
        )
        self._warnings = counter("scene_warnings_total", "Warnings in answers", (*_MODEL, "code"))
        pending = gauge(
            "scene_pending", "Weight of the requests that wait or run in each lane", ("lane",)
        )
        for lane in ("quick", "slow", "draws"):
            pending.labels(lane).set_function(partial(getattr, getattr(admission, lane), "weight"))
        self._info = gauge(
            "scene_model_info",
            "1 for each served model, with one series per alias",
            (*_MODEL, "variant", "digest", "alias"),
        )
        self._reloads = counter(
            "scene_reloads_total", "Attempts to load changes in the store", ("outcome",)
        )
        gauge(
            "scene_start_time_seconds", "Unix time when the process began to load its models"
        ).set(time.time())
        self._ready = gauge(
            "scene_ready_time_seconds", "Unix time when the default model first answered; 0 before"
        )
        self.max_age = 1.0  # maximum age in seconds of the text that `exposition` returns
        self._written_at = 0.0
        self._text: asyncio.Future[bytes] | None = None
        self._infos: set[tuple[str, str, str, str, str]] = set()
        self._is_ready = False
        # Look-ups of series by label values take a tenth of a request's time in the library. So the
        # series are kept here: of requests, and of the questions of each served model.
        self._of_requests = cache(
            lambda route, kind: (self._requests.labels(route, kind), self._latency.labels(route))
        )
        self._of_model: dict[Key, dict[str, tuple[Histogram, Histogram, Counter]]] = {}
        for outcome in get_args(Outcome):
            self._reloads.labels(outcome)

    def serving(self, models: ServedModels) -> None:
        """Report these models as served, and remove the series of all other models."""
        findings = self._alarms, self._unknown, self._warnings
        for key in self._of_model.keys() - models.served.keys():
            del self._of_model[key]
            for metric in (self._queue, self._compute, self._objects, *findings):
                metric.remove_by_labels(dict(zip(_MODEL, key, strict=True)))
        for key in models.served.keys() - self._of_model.keys():
            self._of_model[key] = {}
            # A rate misses the first increase of a series that did not exist before.
            for counter, values in zip(findings, _FINDINGS, strict=True):
                for value in values:
                    counter.labels(*key, value)
        # A model without alias has the alias "".
        infos = {
            (*key, model.reference.variant, model.reference.digest, alias)
            for key, model in models.served.items()
            for alias in models.aliases[key] or [""]
        }
        for info in self._infos - infos:
            self._info.remove(*info)
        for info in infos - self._infos:
            self._info.labels(*info).set(1)
        self._infos = infos
        if not self._is_ready and any(alias == DEFAULT for *_, alias in infos):
            self._is_ready = True
            self._ready.set(time.time())

    def reloaded(self, outcome: Outcome) -> None:
        """Count one attempt to load changes in the store, with its outcome."""
        self._reloads.labels(outcome).inc()

    def answered(self, route: str, outcome: str, seconds: float) -> None:
        """Count one answered request, by the template of its route, or "-" without a route."""
        requests, latency = self._of_requests(route, outcome)
        requests.inc()
        latency.observe(seconds)

    def entry_answered(self, question: str, outcome: str) -> None:
        """Count one scene of a batch. Its outcome is "success" or the slug of the problem type."""
        self._entries.labels(question, outcome).inc()

    def computed(
        self, key: Key, question: str, waited: float, seconds: float, objects: int, answer: Fields
    ) -> None:
        """Record one answered question: its waiting time, computing time, objects and answer."""
        questions = self._of_model.get(key)
        if questions is None:  # the model is no longer served, and its series are removed
            return
        series = questions.get(question)
        if series is None:
            series = questions[question] = (
                self._queue.labels(*key),
                self._compute.labels(*key, question),
                self._objects.labels(*key, question),
            )
        queue, compute, counted = series
        queue.observe(waited)
        compute.observe(seconds)
        counted.inc(objects)
        outliers = [entry["is_outlier"] for entry in answer.get("outliers", ())]
        misplaced = [entry["is_misplaced"] for entry in answer.get("misplaced", ())]
        guessed = [mapped.rule in _GUESSES for mapped in answer["mapped"]]
        for counter, value, number in (
            (self._alarms, "outlier", sum(outliers)),
            (self._alarms, "misplaced", sum(misplaced)),
            (self._unknown, "ignored", len(answer["ignored"])),
            (self._unknown, "guessed", sum(guessed)),
        ):
            if number:
                counter.labels(*key, value).inc(number)
        for warning in answer["warnings"]:
            self._warnings.labels(*key, warning.code).inc()

    async def exposition(self) -> bytes:
        """Return all metrics as text, at most `max_age` old. A thread formats them."""
        if self._text is None or monotonic() - self._written_at >= self.max_age:
            self._written_at = monotonic()
            self._text = asyncio.ensure_future(asyncio.to_thread(generate_latest, self._registry))
        return await asyncio.shield(self._text)
