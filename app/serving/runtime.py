"""What the process serves: one snapshot of models, and the ways to change it."""

from __future__ import annotations

import asyncio
import ctypes
import gc
import logging
import sys
from collections.abc import Awaitable, Callable, Iterable
from functools import wraps
from typing import Concatenate, Literal, ParamSpec, TypeVar

from app.compiling import check_cache, progress
from app.registry import AliasTarget, Store, StoreError, StoreState, load_model_set
from app.serving.admission import Backlog, Threads, WorkQueue
from app.serving.errors import (
    AliasConflictError,
    DrainingError,
    Fault,
    ModelUnavailableError,
    ModelUnusableError,
    NotReadyError,
    Reason,
    RefreshRefusedError,
    RequestError,
    ServingError,
    StoreBusyError,
    StoreNotWritableError,
    UnknownModelError,
)
from app.serving.metrics import Change as Counted
from app.serving.metrics import Metrics
from app.serving.models import DEFAULT, Key, ServedModels
from app.serving.reading import Limits
from app.serving.request import Record, Request
from app.serving.warm_up import prepare
from app.settings import Settings
from scene_client.schemas import AliasAnswer, AliasRequest, RefreshAnswer

P = ParamSpec("P")
T = TypeVar("T")

_logger = logging.getLogger("app.serving")

# An administrator waits this long for another writer; the requests of robots never do.
_LOCK_TIMEOUT = 5.0

# Seconds after which the worker thread, where it interprets and does not compute, gives way to the
# event loop. The interpreter's default of 5 ms is a quarter of a robot's tick.
_SWITCH_INTERVAL = 5e-4


def _counted(
    change: Counted,
) -> Callable[
    [Callable[Concatenate[Runtime, P], Awaitable[T]]],
    Callable[Concatenate[Runtime, P], Awaitable[T]],
]:
    """Count every attempt of a method to change what is served, by how it went."""

    def decorate(
        method: Callable[Concatenate[Runtime, P], Awaitable[T]],
    ) -> Callable[Concatenate[Runtime, P], Awaitable[T]]:
        @wraps(method)
        async def attempt(self: Runtime, /, *args: P.args, **kwargs: P.kwargs) -> T:
            try:
                answer = await method(self, *args, **kwargs)
            except ServingError:
                self.metrics.reloaded(change, "refused")
                raise
            except Exception:
                self.metrics.reloaded(change, "failed")
                raise
            self.metrics.reloaded(change, "success")
            return answer

        return attempt

    return decorate


class Runtime:
    """The one holder of the current snapshot.

    Args:
        settings: of the service.

    Attributes:
        backlog: the requests that wait to be read.
        metrics: of the service.
    """

    def __init__(self, settings: Settings) -> None:
        self.metrics = Metrics()
        self.backlog = Backlog(settings.queue_requests)
        self._store = Store(
            settings.store,
            lock_timeout=_LOCK_TIMEOUT,
            max_weights_bytes=settings.max_weights_bytes,
        )
        self._limits = Limits(
            settings.max_objects, settings.max_relations, settings.max_answer_bytes
        )
        self._queue_rows = settings.queue_rows
        self._threads = Threads()
        self._poll = settings.store_poll
        self._polling: asyncio.Task[None] | None = None
        self._changing = asyncio.Lock()
        self._models: ServedModels | None = None
        self._seen: StoreState | None = None

    @property
    def models(self) -> ServedModels:
        """The current snapshot.

        Raises:
            NotReadyError: nothing has been loaded yet.
        """
        if self._models is None:
            raise NotReadyError("The service is starting.")
        return self._models

    def request(
        self,
        deadline: float,
        request_id: str,
        record: Record | None = None,
        is_gone: Callable[[], Awaitable[bool]] | None = None,
    ) -> Request:
        """A request that sees the current snapshot from beginning to end.

        Args:
            deadline, is_gone: see `Ticket`.
            request_id: goes into every answer.
            record: what becomes known about the request.

        Raises:
            NotReadyError: nothing has been loaded yet.
        """
        return Request(
            deadline,
            is_gone,
            request_id,
            record or Record(),
            models=self.models,
            limits=self._limits,
            metrics=self.metrics,
        )

    @property
    def draining(self) -> bool:
        """Whether nothing new is begun."""
        return self.backlog.draining

    def check_ready(self) -> None:
        """Return if requests that name no model can be answered.

        Raises:
            NotReadyError, DrainingError: they cannot.
        """
        if self.draining:
            raise DrainingError("The service finishes the requests in progress, and then ends.")
        self.models.resolve(DEFAULT)

    def drain(self) -> None:
        """Refuse new requests and turn readiness off."""
        self.backlog.draining = True

    async def start(self) -> None:
        """Load, verify and warm everything in the store; `models` tells what is wrong."""
        sys.setswitchinterval(_SWITCH_INTERVAL)
        self.metrics.started()
        check_cache()
        # No request waits yet, and another thread would cost time and memory.
        self._serve(self._load(None))
        for failure in self.models.failures.values():
            _logger.error("%s: %s: %s", failure.subject, failure.reason, failure.detail)
        if self._poll:
            self._polling = asyncio.create_task(self._follow())

    def stop(self) -> None:
        """Let go of the worker threads; what they have not begun is dropped."""
        if self._polling is not None:
            self._polling.cancel()
        self._threads.stop()

    @_counted("refresh")
    async def refresh(self, request_id: str) -> RefreshAnswer:
        """Take over what the store holds now, or leave everything as it is.

        Refused is what makes the service worse: anything that fails and did not before, and any
        state whose default model is not usable.

        Raises:
            RefreshRefusedError: nothing has changed.
            NotReadyError: nothing has been loaded yet.
        """
        async with self._changing:
            # Not the old snapshot itself: its memory is to be free when the new one settles.
            failed, served = set(self.models.failures), set(self.models.served)
            new = await self._take_over(lambda subject: subject == DEFAULT or subject not in failed)
            return RefreshAnswer(
                request_id=request_id,
                default=new.resolve(DEFAULT).reference,
                added=_names(set(new.served) - served),
                removed=_names(served - set(new.served)),
                failures=list(new.failures.values()),
            )

    @_counted("alias")
    async def move_alias(self, alias: str, request: AliasRequest, request_id: str) -> AliasAnswer:
        """Let an alias lead to a version that is served, here at once and in the store for good.

        Raises:
            RequestError: no alias can have this name.
            UnknownModelError: no such model or version is served.
            ModelUnusableError: the version was refused.
            AliasConflictError: the alias leads elsewhere than expected, or is a model's name.
            StoreNotWritableError, StoreBusyError: the store cannot be changed (now).
            NotReadyError: nothing has been loaded yet.
        """
        async with self._changing:
            target = self._target(request.model)
            expected = _expected(request)
            try:
                previous = self._store.aliases().get(alias)
                await asyncio.to_thread(self._store.set_alias, alias, target, expected=expected)
            except StoreError as error:
                raise _refusal(error) from None
            self._serve(self.models.with_alias(alias, target))
            return AliasAnswer(
                request_id=request_id,
                alias=alias,
                model=str(target),
                previous=None if previous is None else str(previous),
            )

    async def _follow(self) -> None:
        """Take over what others change in the store: publishers, operators, other replicas."""
        while True:
            await asyncio.sleep(self._poll)
            if await asyncio.to_thread(self._store.state) == self._seen:
                continue
            try:
                await self._take_over_changes()
            except RefreshRefusedError as error:
                for failure in error.failures:
                    _logger.error(
                        "The store's changes are not served: %s: %s: %s",
                        *(failure.subject, failure.reason, failure.detail),
                    )
            except Exception:
                _logger.exception("The store's changes could not be loaded")

    @_counted("poll")
    async def _take_over_changes(self) -> None:
        """Take over the store's changes; a version or alias that works now must go on working.

        New versions that fail are listed as refused and keep nothing else back.

        Raises:
            RefreshRefusedError: something would stop working; nothing has changed.
        """
        async with self._changing:
            await self._take_over(self.models.usable.__contains__)

    async def _take_over(self, matters: Callable[[str], bool]) -> ServedModels:
        """Load the store and serve it.

        Args:
            matters: whether the failure of a subject keeps everything as it is.

        Raises:
            RefreshRefusedError: such a subject fails.
        """
        # In a thread, so that the old snapshot goes on answering.
        new = await asyncio.to_thread(self._load, self.models)
        worse = [failure for subject, failure in new.failures.items() if matters(subject)]
        if worse:
            raise RefreshRefusedError(worse)
        self._serve(new)
        return new

    def _serve(self, models: ServedModels) -> None:
        unchanged = self._models is not None and self._models.served == models.served
        self._models = models
        self.metrics.serving(models)
        if not unchanged:
            _settle_memory()

    def _load(self, previous: ServedModels | None) -> ServedModels:
        # Before anything is read: what changes meanwhile is seen by the next look.
        self._seen = self._store.state()
        known = None if previous is None else previous.store
        with progress():
            return prepare(load_model_set(self._store, known), self._new_queue, previous)

    def _new_queue(self) -> WorkQueue:
        return WorkQueue(self._queue_rows, self._threads, self.backlog)

    def _target(self, reference: str) -> AliasTarget:
        try:
            found = self.models.resolve(reference).reference
        except (ModelUnavailableError, NotReadyError):
            raise ModelUnusableError("This version was refused when it was loaded.") from None
        # A model's bare name stays one, so that the alias follows its newest version.
        newest = reference == found.name
        return AliasTarget(name=found.name, version=None if newest else found.version)


def _expected(request: AliasRequest) -> AliasTarget | Literal["any"] | None:
    if "expected" not in request.model_fields_set:
        return "any"
    if request.expected is None:
        return None
    name, at, version = request.expected.partition("@")
    try:
        return AliasTarget(name=name, version=version if at else None)
    except ValueError:
        raise AliasConflictError("No alias leads where the request expected.") from None


def _refusal(error: StoreError) -> Exception:
    match error.code:
        case "alias_conflict":
            return AliasConflictError("The alias does not lead where the request expected.")
        case "name_conflict":
            return AliasConflictError("A model has this name, so no alias can.")
        case "invalid_reference":
            return RequestError(Reason.INVALID, [Fault((), error.reason)])
        case "unknown_model" | "unknown_version":
            return UnknownModelError("The store no longer has this version.")
        case "locked":
            return StoreBusyError("Another process is writing to the store.")
        case _:
            return StoreNotWritableError(f"The store's aliases cannot be changed: {error.reason}.")


def _names(keys: Iterable[Key]) -> list[str]:
    return [f"{name}@{version}" for name, version in sorted(keys)]


def _settle_memory() -> None:
    """Exclude long-lived objects from garbage collection.

    A full collection stops every thread for tens of milliseconds. Frozen objects of a replaced
    snapshot are unfrozen first, or their cycles would never be freed; at the start there are none.
    Pages that loading has left empty go back to the system, where the C library can do that: some
    30 MB.
    """
    gc.unfreeze()
    if gc.isenabled():
        gc.collect()
    if (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)) is not None:
        trim(0)
    gc.freeze()
    gc.enable()
