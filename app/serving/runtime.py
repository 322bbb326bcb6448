"""The runtime of the process. It contains the current snapshot of the models."""

import asyncio
import ctypes
import gc
import logging
import sys
from collections.abc import Iterable
from contextlib import suppress

from app import errors
from app.compiling import check_cache, progress
from app.questions.reading import Limits
from app.registry import DEFAULT_STORE, Store, StoreState, load_model_set
from app.registry.model_set import with_default
from app.serving.admission import Admission, Bodies
from app.serving.metrics import Metrics, Outcome
from app.serving.models import DEFAULT, NO_MODELS, ServedModels, warm_up
from app.settings import Settings
from scene_client.recorder import Recorder
from scene_client.schemas import Failure

_logger = logging.getLogger("app.serving")

# Time in seconds after which the interpreter switches from a worker thread to the event loop.
# Python's default of 5 ms would delay answers by a quarter of a robot's control cycle (20 ms).
_SWITCH_INTERVAL = 1e-4


class Runtime:
    """The runtime of the service. It contains the current snapshot of the models."""

    def __init__(self, settings: Settings) -> None:
        self.admission = Admission(settings.queue_requests, settings.queue_rows)
        self.bodies = Bodies(settings)
        # At shutdown, readiness checks fail, and connections close after their answers.
        self.draining = False
        self.metrics = Metrics(self.admission)
        self._store = Store(settings.store, max_weights_bytes=settings.max_weights_bytes)
        self._release = Store(DEFAULT_STORE)  # models of this release
        self.limits = Limits(
            settings.max_objects, settings.max_relations, settings.max_answer_bytes
        )
        self.recorder: Recorder | None = None  # of confirmed scenes; only with an API key
        if settings.recording is not None and settings.api_key is not None:
            self.recorder = Recorder(settings.recording)
        self._poll = settings.store_poll  # seconds between two checks of the store; 0: none
        self._requested = asyncio.Event()  # set to check the store at once
        self._following: asyncio.Task[None] | None = None
        self.models = NO_MODELS  # until the start
        self._loaded_state: StoreState | None = None

    def check_ready(self) -> None:
        """Raise NotReadyError without a usable default model, or DrainingError at shutdown."""
        if self.draining:
            raise errors.DrainingError
        self.models.resolve(DEFAULT)

    async def start(self) -> None:
        """Load, verify and warm up all versions in the store, and follow its changes."""
        sys.setswitchinterval(_SWITCH_INTERVAL)
        check_cache()
        # The models load on this thread, because the service has no requests yet.
        self._serve(self._load())
        self._following = asyncio.create_task(self._follow_store())

    def stop(self) -> None:
        """Stop the worker threads and drop the computations that have not started."""
        if self._following is not None:
            self._following.cancel()
        self.admission.stop()

    def request_check(self) -> None:
        """Make the service load the state of the store now, also an unchanged one."""
        self._requested.set()

    async def check_store(self, *, always: bool = False) -> None:
        """Load the state of the store and serve it, if another process has changed the store.

        If a new version fails, the service lists this version as refused and serves the other
        changes. If a usable version or alias would become unusable, the service serves no change.
        With ``always``, it loads an unchanged state, too.
        """
        outcome: Outcome = "failed"
        try:
            if not always and await asyncio.to_thread(self._store.state) == self._loaded_state:
                return
            # `_load` runs in a thread, so that the event loop can answer from the old snapshot.
            new = await asyncio.to_thread(self._load)
            lost = self.models.lost_in(new)
            outcome = "refused" if lost else "success"
            if lost:
                _log_failures("the service refused the changes in the store: ", lost)
            else:
                self._serve(new)
        except Exception:
            _logger.exception("the service could not load the changes in the store")
        self.metrics.reloaded(outcome)

    async def _follow_store(self) -> None:
        """Check the store regularly, and at once after `request_check`."""
        while True:
            with suppress(TimeoutError):
                async with asyncio.timeout(self._poll or None):
                    await self._requested.wait()
            is_requested = self._requested.is_set()
            self._requested.clear()
            await self.check_store(always=is_requested)

    def _serve(self, models: ServedModels) -> None:
        """Answer from a new snapshot of the models. Log new failures and moved aliases."""
        previous, self.models = self.models, models
        is_first = previous is NO_MODELS
        old = {} if is_first else previous.failures
        new = [failure for name, failure in models.failures.items() if old.get(name) != failure]
        _log_failures("", new)
        if not is_first:
            _logger.info("the service has loaded the store: %d usable versions", len(models.served))
        for alias, target in models.store.aliases.items():
            if not is_first and previous.store.aliases.get(alias) != target:
                _logger.info("the alias %s names %s now", alias, target)
        self.metrics.serving(models)
        if is_first or previous.served != models.served:
            _freeze_memory()

    def _load(self) -> ServedModels:
        """Load, verify and warm up the models in the store. Unchanged models are reused."""
        # Read the state first. So the next check finds changes that are made during the load.
        self._loaded_state = self._store.state()
        with progress():
            previous = self.models.store
            models = load_model_set(self._store, previous, warm_up, self._release)
            return ServedModels(with_default(models, self._release, previous, warm_up))


def _log_failures(prefix: str, failures: Iterable[Failure]) -> None:
    for failure in failures:
        _logger.error("%s%s: %s: %s", prefix, failure.subject, failure.reason, failure.detail)


def _freeze_memory() -> None:
    """Exclude long-lived objects from garbage collection, and release unused memory.

    A full collection of all objects would stop every thread for 0.1 s. Objects of a replaced
    snapshot stay frozen: they form no reference cycles, so Python frees them without the collector.
    malloc_trim returns about 30 MB to the operating system after the load.
    """
    if gc.isenabled():
        gc.collect()  # objects that are not frozen yet
    if (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)) is not None:
        trim(0)
    gc.freeze()
    gc.enable()
