# Written by `make format` from asynchronous.py; do not edit.
"""The client: `AsyncClient`, and `Client`, which is generated from it by `make format`."""

from __future__ import annotations

import time
from collections.abc import Iterable
from time import monotonic
from types import TracebackType
from typing import Final, Self, Unpack, overload

import httpx

from scene_client.calls import Call, Objects, T, ask, ask_each, promote, segment
from scene_client.connection import RETRIES, DeadlineTransport, Options, deadline
from scene_client.errors import AnswerError, DeadlineError, ProblemError, UnreachableError
from scene_client.schemas import (
    AliasAnswer,
    AliasFields,
    BatchAnswer,
    Body,
    ContextsAnswer,
    GenerateAnswer,
    GenerateFields,
    GenerateRequest,
    Health,
    MissingAnswer,
    MissingFields,
    MissingRequest,
    ModelList,
    ModelSummary,
    OutliersAnswer,
    OutliersFields,
    OutliersRequest,
    RefreshAnswer,
    RelationsAnswer,
    RelationsFields,
    RelationsRequest,
    VersionDetails,
    VocabularyAnswer,
)

MAX_ANSWER: Final = 256 * 2**20
"""Bytes; a batch of 256 scenes with 4,096 relations each stays below."""


class Client:
    """Asks a service.

    `Client` waits for each answer, and threads may share one. The same methods of `AsyncClient`
    are coroutines.

    Args:
        url: of the service.
        timeout: seconds for a whole call, further attempts and the pauses between them included.
        api_key: where the service asks for one.
        admin_key: for `refresh` and `promote`.
        model: asked where a request names none; left out, the service's default.
        retries: further attempts at most, as far as there is time: after 429, 503 and broken
            connections.
        transport: what carries requests; by default pooled connections.

    Every question takes objects and the request's own fields, or a whole request alone, and
    ``timeout`` for this one call.

    Raises:
        InvalidRequestError: the service would refuse the request as malformed.
        ProblemError: the service answered with a problem.
        DeadlineError: the time was over.
        UnreachableError: there is no connection.
        AnswerError: the answer cannot be read.
    """

    def __init__(
        self,
        url: str = "http://127.0.0.1:8000",
        *,
        timeout: float = 10.0,
        api_key: str | None = None,
        admin_key: str | None = None,
        model: str | None = None,
        retries: int = RETRIES,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        self.options = Options(url, timeout, api_key, admin_key, model, retries)
        if transport is None:
            transport = DeadlineTransport(self.options.ssl_context())
        self._http = httpx.Client(transport=transport, trust_env=False)

    # ------------------------------------------------------------------------------ questions

    def relations(
        self,
        objects: Objects | RelationsRequest | Body,
        *,
        timeout: float | None = None,
        **fields: Unpack[RelationsFields],
    ) -> RelationsAnswer:
        """How do these objects stand to each other?"""
        call = ask(
            "/relations", RelationsRequest, RelationsAnswer, objects, fields, self.options.model
        )
        return self._call(call, timeout)

    def missing(
        self,
        objects: Objects | MissingRequest | Body,
        *,
        timeout: float | None = None,
        **fields: Unpack[MissingFields],
    ) -> MissingAnswer:
        """What else should be here, and where?"""
        form, answer = MissingRequest, MissingAnswer
        call = ask("/missing", form, answer, objects, fields, self.options.model)
        return self._call(call, timeout)

    def outliers(
        self,
        objects: Objects | OutliersRequest | Body,
        *,
        timeout: float | None = None,
        **fields: Unpack[OutliersFields],
    ) -> OutliersAnswer:
        """What does not belong here, or stands in the wrong place?"""
        call = ask(
            "/outliers", OutliersRequest, OutliersAnswer, objects, fields, self.options.model
        )
        return self._call(call, timeout)

    def generate(
        self,
        objects: Objects | GenerateRequest | Body = (),
        *,
        timeout: float | None = None,
        **fields: Unpack[GenerateFields],
    ) -> GenerateAnswer:
        """What would a scene like this look like?"""
        call = ask(
            "/generate", GenerateRequest, GenerateAnswer, objects, fields, self.options.model
        )
        return self._call(call, timeout)

    # -------------------------------------------------------------------------------- batches

    def relations_batch(
        self,
        scenes: Iterable[Objects | RelationsRequest | Body],
        *,
        timeout: float | None = None,
    ) -> BatchAnswer[RelationsAnswer]:
        """As `relations`, for up to 256 scenes; what the model refuses spoils one entry only."""
        form, answer = RelationsRequest, BatchAnswer[RelationsAnswer]
        call = ask_each("/relations", form, answer, scenes, self.options.model)
        return self._call(call, timeout)

    def missing_batch(
        self,
        scenes: Iterable[Objects | MissingRequest | Body],
        *,
        timeout: float | None = None,
    ) -> BatchAnswer[MissingAnswer]:
        """As `missing`, for up to 256 scenes; what the model refuses spoils one entry only."""
        form, answer = MissingRequest, BatchAnswer[MissingAnswer]
        call = ask_each("/missing", form, answer, scenes, self.options.model)
        return self._call(call, timeout)

    def outliers_batch(
        self,
        scenes: Iterable[Objects | OutliersRequest | Body],
        *,
        timeout: float | None = None,
    ) -> BatchAnswer[OutliersAnswer]:
        """As `outliers`, for up to 256 scenes; what the model refuses spoils one entry only."""
        form, answer = OutliersRequest, BatchAnswer[OutliersAnswer]
        call = ask_each("/outliers", form, answer, scenes, self.options.model)
        return self._call(call, timeout)

    # --------------------------------------------------------------------------------- models

    def models(self, *, timeout: float | None = None) -> ModelList:
        """Models, versions and aliases."""
        return self._call(Call("GET", "/models", ModelList), timeout)

    @overload
    def model(self, name: str, *, timeout: float | None = None) -> ModelSummary: ...

    @overload
    def model(self, name: str, version: str, *, timeout: float | None = None) -> VersionDetails: ...

    def model(
        self, name: str, version: str | None = None, *, timeout: float | None = None
    ) -> ModelSummary | VersionDetails:
        """The versions of a model, or all there is to know about one of them."""
        path = f"/models/{segment(name)}"
        if version is None:
            return self._call(Call("GET", path, ModelSummary), timeout)
        path += f"/versions/{segment(version)}"
        return self._call(Call("GET", path, VersionDetails), timeout)

    def vocabulary(
        self, name: str | None = None, *, timeout: float | None = None
    ) -> VocabularyAnswer:
        """The words of a model."""
        path = f"/models/{segment(name or self.options.model or 'default')}/vocabulary"
        return self._call(Call("GET", path, VocabularyAnswer), timeout)

    def contexts(self, name: str | None = None, *, timeout: float | None = None) -> ContextsAnswer:
        """The hidden units of a model by their strongest objects."""
        path = f"/models/{segment(name or self.options.model or 'default')}/contexts"
        return self._call(Call("GET", path, ContextsAnswer), timeout)

    def refresh(self, *, timeout: float | None = None) -> RefreshAnswer:
        """Let the service take over what its store holds now; needs the admin key."""
        call = Call("POST", "/models/refresh", RefreshAnswer, administers=True)
        return self._call(call, timeout)

    def promote(
        self,
        alias: str,
        model: str,
        *,
        timeout: float | None = None,
        **fields: Unpack[AliasFields],
    ) -> AliasAnswer:
        """Let an alias lead to a model or a version of it; needs the admin key.

        Not asked again after a broken connection, which may have broken after the alias moved.

        Args:
            alias: ``default``, or any other.
            model: ``name@version``, or ``name`` for its newest.
            **fields: ``expected``: where it must lead now; None: it must not exist yet.
        """
        return self._call(promote(alias, {"model": model, **fields}), timeout)

    # --------------------------------------------------------------------------------- health

    def is_live(self, *, timeout: float | None = None) -> bool:
        """Whether the service answers at all; asked once."""
        return self._is("live", timeout)

    def is_ready(self, *, timeout: float | None = None) -> bool:
        """Whether the service's default model answers; asked once."""
        return self._is("ready", timeout)

    def check_ready(self, *, timeout: float | None = None) -> None:
        """Return if the service's default model answers; asked once.

        Raises:
            UnreachableError, DeadlineError, ProblemError: it does not, and so.
        """
        self._call(Call("GET", "/health/ready", Health), timeout, retries=0)

    def _is(self, health: str, timeout: float | None) -> bool:
        try:
            self._call(Call("GET", f"/health/{health}", Health), timeout, retries=0)
        except (UnreachableError, DeadlineError):
            return False
        except ProblemError as problem:
            if problem.status != 503:
                raise
            return False
        return True

    # ----------------------------------------------------------------------------------- a call

    def _call(self, call: Call[T], timeout: float | None, retries: int | None = None) -> T:
        """The answer of a call, after as many attempts as its time allows."""
        retries = self.options.retries if retries is None else retries
        limit = self.options.limit(timeout)
        ends = monotonic() + limit
        attempt = 0
        while (left := ends - monotonic()) > 0:
            try:
                answer = self._attempt(call, left)
            except (TimeoutError, httpx.TimeoutException):
                break
            except (ProblemError, UnreachableError) as error:
                pause = call.retry_pause(error, attempt)
                if pause is None or attempt == retries or pause >= ends - monotonic():
                    raise
                attempt += 1
                time.sleep(pause)
            else:
                # Reading takes time, too. The caller does not wait for a later answer.
                if monotonic() < ends:
                    return answer
        raise DeadlineError(f"No answer within {limit:g} s.")

    def _attempt(self, call: Call[T], left: float) -> T:
        """The answer of a call that is sent once, and may take so many seconds."""
        options, body = self.options, bytearray()
        with deadline(left):
            try:
                with self._http.stream(
                    call.method,
                    options.address(call),
                    content=call.body,
                    headers=options.headers(call, left),
                    timeout=left,
                ) as response:
                    for part in response.iter_bytes():
                        body += part
                        if len(body) > MAX_ANSWER:
                            raise AnswerError("The answer is too long.")
            except httpx.TimeoutException:
                raise
            except httpx.TransportError as error:
                raise options.unreachable(error) from error
        return call.read(response.status_code, response.headers, bytes(body))

    # ------------------------------------------------------------------------------- lifetime

    def close(self) -> None:
        """Close every connection."""
        self._http.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()
