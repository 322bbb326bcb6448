"""Metrics for Prometheus: counted where it happens, written out when `/metrics` is asked.

Every label has few values, whatever clients send: routes by their templates, models only while
they are served. A replica is one process and tells its own; see docs/decisions/artifacts.md.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from functools import partial
from typing import Final, Literal, get_args

from prometheus_client import (
    CONTENT_TYPE_PLAIN_0_0_4,
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    disable_created_metrics,
    generate_latest,
)

from app.serving.errors import ServingError
from app.serving.models import DEFAULT, Key, ServedModels

CONTENT_TYPE: Final = CONTENT_TYPE_PLAIN_0_0_4

Change = Literal["refresh", "alias", "poll"]
Outcome = Literal["success", "refused", "failed"]
Info = tuple[str, str, str, str, str]

_SECONDS: Final = (
    *(0.0001, 0.00025, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025),
    *(0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0),
)
_ROWS: Final = (1, 2, 4, 8, 16, 32, 64, 128, 256)
_MODEL: Final = ("model", "version")
_INFO: Final = "scene_model_info"

# A second series for each one that says when it began: Prometheus itself sees when a counter
# restarts.
disable_created_metrics()  # type: ignore[no-untyped-call]


class Metrics:
    """The metrics of one application; its methods are called on the thread of the event loop.

    Attributes:
        registry: of its own, so that a process can hold several applications.
    """

    def __init__(self) -> None:
        self.registry = registry = CollectorRegistry()
        self._requests = Counter(
            "scene_requests_total",
            "Requests answered; outcome is success or the name of the problem",
            ("route", "method", "outcome"),
            registry=registry,
        )
        self._latency = Histogram(
            "scene_request_duration_seconds",
            "From the request's first byte to the response's last",
            ("route",),
            buckets=_SECONDS,
            registry=registry,
        )
        self._entries = Counter(
            "scene_batch_entries_total",
            "Scenes of batch requests, each of which succeeds or fails on its own",
            ("question", "outcome"),
            registry=registry,
        )
        self._queue = Histogram(
            "scene_queue_duration_seconds",
            "How long a scene waited before a model looked at it",
            _MODEL,
            buckets=_SECONDS,
            registry=registry,
        )
        self._compute = Histogram(
            "scene_compute_duration_seconds",
            "How long a model computed for the scenes that it answered together",
            (*_MODEL, "question"),
            buckets=_SECONDS,
            registry=registry,
        )
        self._rows = Histogram(
            "scene_batch_rows",
            "How many scenes a model answered together",
            (*_MODEL, "question"),
            buckets=_ROWS,
            registry=registry,
        )
        self._serialisation = Histogram(
            "scene_serialisation_duration_seconds",
            "From a model's last answer to the response's first byte",
            buckets=_SECONDS,
            registry=registry,
        )
        self._pending = Gauge(
            "scene_pending_rows",
            "Scenes waiting for a model",
            _MODEL,
            registry=registry,
        )
        self._streams = Gauge(
            "scene_streams",
            "Streams that are open",
            registry=registry,
        )
        self._messages = Counter(
            "scene_stream_messages_total",
            "Messages of streams; outcome is success or the name of the problem",
            ("type", "outcome"),
            registry=registry,
        )
        self._answers = Counter(
            "scene_stream_answers_total",
            "Answers to streams; outcome is success or the name of the problem",
            ("outcome",),
            registry=registry,
        )
        self._superseded = Counter(
            "scene_stream_superseded_total",
            "Updates of streams that a newer one replaced before they were answered",
            registry=registry,
        )
        self._info = Gauge(
            _INFO,
            "1 for every model that is served, once for each alias that leads to it",
            (*_MODEL, "variant", "digest", "alias"),
            registry=registry,
        )
        self._reloads = Counter(
            "scene_reloads_total",
            "Changes of what is served: refreshes, moved aliases, polls, with refused ones",
            ("change", "outcome"),
            registry=registry,
        )
        self._started = Gauge(
            "scene_start_time_seconds",
            "Unix time when the process began to load its models",
            registry=registry,
        )
        self._ready = Gauge(
            "scene_ready_time_seconds",
            "Unix time when its default model had answered; 0 before",
            registry=registry,
        )
        self._infos: set[Info] = set()
        self._is_ready = False
        # Bound once: looking a child up by its labels costs more than counting.
        self._of_request: dict[tuple[str, str, str], Counter] = {}
        self._of_route: dict[str, Histogram] = {}
        self._of_model: dict[Key, dict[str, tuple[Histogram, Histogram, Histogram]]] = {}

    # ------------------------------------------------------------------------- what happened

    def started(self) -> None:
        """The process begins to load its models."""
        self._started.set(time.time())
        for change in get_args(Change):
            for outcome in get_args(Outcome):
                self._reloads.labels(change, outcome)

    def serving(self, models: ServedModels) -> None:
        """These models are served from now on; series of all others go away."""
        for key in self._of_model.keys() - models.served.keys():
            for question in self._of_model.pop(key):
                self._compute.remove(*key, question)
                self._rows.remove(*key, question)
            self._queue.remove(*key)
            self._pending.remove(*key)
        for key, model in models.served.items():
            self._of_model.setdefault(key, {})
            self._queue.labels(*key)
            self._pending.labels(*key).set_function(partial(getattr, model.queue, "rows"))
        infos = set(_infos(models))
        for info in self._infos - infos:
            self._info.remove(*info)
        for info in infos - self._infos:
            self._info.labels(*info).set(1)
        self._infos = infos
        if not self._is_ready and any(alias == DEFAULT for *_, alias in infos):
            self._is_ready = True
            self._ready.set(time.time())

    def reloaded(self, change: Change, outcome: Outcome) -> None:
        """Somebody tried to change what is served."""
        self._reloads.labels(change, outcome).inc()

    def answered(
        self,
        route: str,
        method: str,
        outcome: str,
        seconds: float | None,
        serialised: float | None = None,
    ) -> None:
        """A request has been answered.

        Args:
            route: the template of the route, "-" where none answered.
            method: the request's, "-" if HTTP defines no such method.
            outcome: "success", or the name of the problem.
            seconds: how long it took; None for a stream, which lasts as long as its client likes.
            serialised: seconds from a model's last answer to the response; None without one.
        """
        key = (route, method, outcome)
        counter = self._of_request.get(key)
        if counter is None:
            counter = self._of_request[key] = self._requests.labels(*key)
        counter.inc()
        if seconds is not None:
            histogram = self._of_route.get(route)
            if histogram is None:
                histogram = self._of_route[route] = self._latency.labels(route)
            histogram.observe(seconds)
        if serialised is not None:
            self._serialisation.observe(serialised)

    def entry_answered(self, question: str, outcome: str) -> None:
        """Count one scene of a batch: answered, or refused with the problem `outcome`."""
        self._entries.labels(question, outcome).inc()

    def streams(self, count: int) -> None:
        """Set the number of open streams."""
        self._streams.set(count)

    def stream_message(self, kind: str, outcome: str) -> None:
        """Count one stream message: accepted, or refused with the problem `outcome`.

        Args:
            kind: its type, "-" if there is no such type.
        """
        self._messages.labels(kind, outcome).inc()

    def stream_answered(self, outcome: str, superseded: int) -> None:
        """A stream has been given an answer, which covers so many updates besides the newest."""
        self._answers.labels(outcome).inc()
        self._superseded.inc(superseded)

    def computed(self, key: Key, question: str, rows: int, waited: float, seconds: float) -> None:
        """A model has answered a question about ``rows`` scenes at once, which waited before.

        Dropped where the model has been removed meanwhile: its series would come back.
        """
        series = self._of_model.get(key)
        if series is None:
            return
        bound = series.get(question)
        if bound is None:
            bound = series[question] = (
                self._queue.labels(*key),
                self._compute.labels(*key, question),
                self._rows.labels(*key, question),
            )
        queue, compute, size = bound
        queue.observe(waited)
        compute.observe(seconds)
        size.observe(rows)

    # ------------------------------------------------------------------------- what is told

    def exposition(self) -> bytes:
        """Everything in Prometheus' text format."""
        return generate_latest(self.registry)


def _infos(models: ServedModels) -> Iterable[Info]:
    """The label values of every model, once an alias; "" where no alias leads to it."""
    aliases: dict[Key, list[str]] = {key: [] for key in models.served}
    for alias in models.store.aliases:
        try:
            reference = models.resolve(alias).reference
        except ServingError:
            continue
        aliases[reference.name, reference.version].append(alias)
    for key, model in models.served.items():
        reference = model.reference
        for alias in aliases[key] or [""]:
            yield (*key, reference.variant, reference.digest, alias)
