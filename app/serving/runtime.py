"""The runtime of the process. It contains the current snapshot of the models."""

from __future__ import annotations

import asyncio
import ctypes
import gc
import logging
import sys
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import asynccontextmanager
from typing import Literal

from app import errors
from app.compiling import check_cache, progress
from app.inference.kernels import KERNELS
from app.questions.reading import Limits
from app.registry import AliasTarget, Store, StoreError, StoreState, load_model_set
from app.serving.admission import Admission, Bodies
from app.serving.metrics import Change, Metrics
from app.serving.models import DEFAULT, NO_MODELS, Key, ServedModels, warm_up
from app.settings import Settings
from scene_client.schemas import AliasAnswer, AliasRequest, RefreshAnswer

_logger = logging.getLogger("app.serving")

# Maximum time in seconds that an administration request waits for the lock of the store.
_LOCK_TIMEOUT = 5.0

# Time in seconds after which the interpreter switches from a worker thread to the event loop.
# Python's default of 5 ms would delay answers by a quarter of a robot's control cycle (20 ms).
_SWITCH_INTERVAL = 1e-4


class Runtime:
    """The runtime of the service. It contains the current snapshot of the models.

    Attributes:
        admission: lanes of requests, and worker threads.
        bodies: bodies of the requests and answers in progress.
        draining: whether the service is shutting down. Readiness checks then fail, and connections
            close after their answers.
        limits: limits on scenes and answers.
        metrics: metrics of the service.
        models: current snapshot of the models; `NO_MODELS` before the start.
    """

    def __init__(self, settings: Settings) -> None:
        self.admission = Admission(settings.queue_requests, settings.queue_rows)
        self.bodies = Bodies(settings)
        self.draining = False
        self.metrics = Metrics(self.admission)
        limit = settings.max_weights_bytes
        self._store = Store(settings.store, lock_timeout=_LOCK_TIMEOUT, max_weights_bytes=limit)
        self.limits = Limits(
            settings.max_objects, settings.max_relations, settings.max_answer_bytes
        )
        self._poll = settings.store_poll
        self._polling: asyncio.Task[None] | None = None
        self._changing = asyncio.Lock()
        self.models = NO_MODELS
        self._loaded_state: StoreState | None = None

    def check_ready(self) -> None:
        """Check that the service accepts requests and that its default model is usable.

        Raises:
            NotReadyError: the default model is not usable.
            DrainingError: the service is shutting down.
        """
        if self.draining:
            raise errors.DrainingError
        self.models.resolve(DEFAULT)

    async def start(self) -> None:
        """Load, verify and warm up all versions in the store.

        Afterwards, `models.failures` contains the refused versions and aliases.
        """
        sys.setswitchinterval(_SWITCH_INTERVAL)
        check_cache()
        # The models load on this thread, because the service has no requests yet. Another thread
        # would cost time and memory.
        self._serve(self._load())
        for failure in self.models.failures.values():
            _logger.error("%s: %s: %s", failure.subject, failure.reason, failure.detail)
        if self._poll:
            self._polling = asyncio.create_task(self._follow_store())

    def stop(self) -> None:
        """Stop the worker threads and drop the computations that have not started."""
        if self._polling is not None:
            self._polling.cancel()
        self.admission.stop()

    async def refresh(self, request_id: str) -> RefreshAnswer:
        """Load the current state of the store and serve it, or keep the served models.

        The service refuses a state of the store with a new failure or without a usable default
        model.

        Raises:
            RefreshRefusedError: the service refused the new state. The served models are unchanged.
        """
        async with self._change("refresh"):
            # These sets contain only names, so Python can free the memory of the old snapshot.
            accepted, served = self.models.failures.keys() - {DEFAULT}, set(self.models.served)
            new = await self._load_and_serve(lambda subject: subject not in accepted)
            return RefreshAnswer(
                request_id=request_id,
                default=new.resolve(DEFAULT).reference,
                added=_names(set(new.served) - served),
                removed=_names(served - set(new.served)),
                failures=list(new.failures.values()),
            )

    async def move_alias(self, alias: str, request: AliasRequest, request_id: str) -> AliasAnswer:
        """Point an alias at a served version, in the store and in this process.

        Raises:
            InvalidRequestError: the name is not valid for an alias.
            UnknownModelError: the service does not serve the model or version.
            ModelUnusableError: the service refused the version.
            AliasConflictError: the alias has another target than expected, or a model has the name
                of the alias.
            StoreNotWritableError: this process cannot write to the store.
            StoreBusyError: another process is writing to the store.
        """
        async with self._change("alias"):
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

    async def _follow_store(self) -> None:
        """Check the store regularly for changes by other processes, and serve the new state.

        If a new version fails, the service lists this version as refused and serves the other
        changes. If a usable version or alias would become unusable, the service serves no change.
        """
        while True:
            await asyncio.sleep(self._poll)
            try:
                async with self._changing:
                    changed = await asyncio.to_thread(self._store.state) != self._loaded_state
                if changed:
                    async with self._change("poll"):
                        await self._load_and_serve(self.models.usable.__contains__)
            except errors.RefreshRefusedError as error:
                for failure in error.failures:
                    reason = f"{failure.subject}: {failure.reason}: {failure.detail}"
                    _logger.error("the service refused the changes in the store: %s", reason)
            except Exception:
                _logger.exception("the service could not load the changes in the store")

    @asynccontextmanager
    async def _change(self, change: Change) -> AsyncIterator[None]:
        """Hold the lock for a change of the served models, and count the outcome of the change."""
        try:
            async with self._changing:
                yield
        except errors.ServiceError:
            self.metrics.reloaded(change, "refused")
            raise
        except Exception:
            self.metrics.reloaded(change, "failed")
            raise
        self.metrics.reloaded(change, "success")

    async def _load_and_serve(self, is_fatal: Callable[[str], bool]) -> ServedModels:
        """Load the state of the store and serve it.

        Args:
            is_fatal: function from the name of an unusable entry (``name@version``, an alias or
                "store") to True, if this failure makes the service refuse the new state.

        Raises:
            RefreshRefusedError: the service refused the new state.
        """
        # `_load` runs in a thread, so that the event loop can answer from the old snapshot.
        new = await asyncio.to_thread(self._load)
        fatal = [failure for subject, failure in new.failures.items() if is_fatal(subject)]
        if fatal:
            detail = "The service still serves the previous versions. `failures` gives the reasons."
            raise errors.RefreshRefusedError(detail, failures=fatal)
        self._serve(new)
        return new

    def _serve(self, models: ServedModels) -> None:
        previous, self.models = self.models, models
        for alias, target in models.store.aliases.items():
            if previous is not NO_MODELS and previous.store.aliases.get(alias) != target:
                _logger.info("the alias %s names %s now", alias, target)
        self.metrics.serving(models)
        if previous is NO_MODELS or previous.served != models.served:
            _freeze_memory()

    def _load(self) -> ServedModels:
        # Read the state before the files. So the next check of the store finds changes that other
        # processes make during the load.
        self._loaded_state = self._store.state()
        with progress(KERNELS):
            return ServedModels(load_model_set(self._store, self.models.store, warm_up))

    def _target(self, reference: str) -> AliasTarget:
        try:
            served = self.models.resolve(reference).reference
        except (errors.ModelUnavailableError, errors.NotReadyError):
            raise errors.ModelUnusableError(
                f"The service refused to load {reference}; GET /models gives the reason."
            ) from None
        # If the reference is a name without a version, the alias follows the newest usable version.
        newest = reference == served.name
        return AliasTarget(name=served.name, version=None if newest else served.version)


def _expected(request: AliasRequest) -> AliasTarget | Literal["any"] | None:
    if "expected" not in request.model_fields_set:
        return "any"
    if request.expected is None:
        return None
    try:
        return AliasTarget.of(request.expected)
    except ValueError:
        raise errors.AliasConflictError(
            "`expected` is not the name of a model or version."
        ) from None


def _refusal(error: StoreError) -> Exception:
    match error.code:
        case "alias_conflict":
            return errors.AliasConflictError("The alias points to another version than expected.")
        case "name_conflict":
            return errors.AliasConflictError("A model already has the name of this alias.")
        case "invalid_reference":
            return errors.InvalidRequestError([errors.LocatedError((), error.reason)])
        case "unknown_model" | "unknown_version":
            return errors.UnknownModelError("The store no longer contains this version.")
        case "locked":
            return errors.StoreBusyError("Another process is writing to the store.")
        case _:
            return errors.StoreNotWritableError(
                f"The service cannot write the aliases: {error.reason}."
            )


def _names(keys: Iterable[Key]) -> list[str]:
    return [f"{name}@{version}" for name, version in sorted(keys)]


def _freeze_memory() -> None:
    """Exclude long-lived objects from garbage collection, and release unused memory.

    A full collection of all objects would stop every thread for 0.1 s. So the function freezes the
    objects of the current snapshot. Objects of a replaced snapshot stay frozen: they form no
    reference cycles, so Python frees them without the collector. At the end, the function returns
    unused memory (about 30 MB after the load) to the operating system, if the C library supports
    this.
    """
    if gc.isenabled():
        gc.collect()  # objects that are not frozen yet
    if (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)) is not None:
        trim(0)
    gc.freeze()
    gc.enable()
