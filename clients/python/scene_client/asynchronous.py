"""The asynchronous client. `make format` generates the blocking client (`sync`) from this file."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from time import monotonic
from typing import overload

import anyio
import httpx
from typing_extensions import Self, Unpack

from scene_client import calls, schemas
from scene_client.calls import Call, Scene, T
from scene_client.connection import MAX_ANSWER, RETRIES, Options, async_deadline, async_transport
from scene_client.errors import AnswerError, DeadlineError, ProblemError, UnreachableError
from scene_client.recorder import Recorder


class AsyncClient:
    """A client of the scene-reasoning service.

    `Client` and `AsyncClient` have the same methods. The methods of `Client` block until the answer
    arrives. Several threads may share one `Client`. The methods of `AsyncClient` are coroutines.

    Args:
        url: base URL of the service.
        timeout: maximum time of a call in seconds, including all retries and pauses.
        api_key: API key, if the service requires an API key.
        model: model for requests without the field ``model``. By default, the service uses its
            default model.
        retries: maximum number of retries of a call. Within the timeout, the client retries after
            status 429 or 503 and after connection errors.
        transport: httpx transport that sends the requests. The default is a pool of connections.
        record: file ``*.jsonl`` to which the client appends the scenes of answered questions, or a
            `Recorder`. docs/clients.md describes the file. By default, nothing is recorded.

    The first argument of a question method is the list of objects. Other fields of the request are
    keyword arguments. The first argument may also be a whole request, without keyword arguments.
    The argument ``timeout`` of a method replaces the timeout of the client for this call.

    Raises:
        InvalidRequestError: the request is invalid. The client has not sent it.
        ProblemError: the service answered with a problem.
        DeadlineError: the timeout has expired.
        UnreachableError: the connection failed.
        AnswerError: the client cannot read the answer.
    """

    def __init__(
        self,
        url: str = "http://127.0.0.1:8000",
        *,
        timeout: float = 10.0,
        api_key: str | None = None,
        model: str | None = None,
        retries: int = RETRIES,
        transport: httpx.AsyncBaseTransport | None = None,
        record: str | Path | Recorder | None = None,
    ) -> None:
        self.options = Options(url, timeout, api_key, model, retries)
        if transport is None:
            transport = async_transport(self.options.ssl_context())
        self._http = httpx.AsyncClient(transport=transport, trust_env=False)
        self._recorder = Recorder(record) if isinstance(record, str | Path) else record

    async def relations(
        self,
        objects: Scene[schemas.RelationsRequest],
        *,
        timeout: float | None = None,
        **fields: Unpack[schemas.RelationsFields],
    ) -> schemas.RelationsAnswer:
        """Return the likely spatial relations between the objects."""
        return await self._call(calls.RELATIONS.call(objects, fields, self.options.model), timeout)

    async def missing(
        self,
        objects: Scene[schemas.MissingRequest],
        *,
        timeout: float | None = None,
        **fields: Unpack[schemas.MissingFields],
    ) -> schemas.MissingAnswer:
        """Return classes that are probably missing from the scene, and their likely places."""
        return await self._call(calls.MISSING.call(objects, fields, self.options.model), timeout)

    async def outliers(
        self,
        objects: Scene[schemas.OutliersRequest],
        *,
        timeout: float | None = None,
        **fields: Unpack[schemas.OutliersFields],
    ) -> schemas.OutliersAnswer:
        """Return how well each object fits the scene, and the relations that are probably false."""
        return await self._call(calls.OUTLIERS.call(objects, fields, self.options.model), timeout)

    async def rooms(
        self,
        objects: Scene[schemas.RoomsRequest],
        *,
        timeout: float | None = None,
        **fields: Unpack[schemas.RoomsFields],
    ) -> schemas.RoomsAnswer:
        """Return the likely types of the room, or where one object usually is."""
        return await self._call(calls.ROOMS.call(objects, fields, self.options.model), timeout)

    async def generate(
        self,
        objects: Scene[schemas.GenerateRequest] = (),
        *,
        timeout: float | None = None,
        **fields: Unpack[schemas.GenerateFields],
    ) -> schemas.GenerateAnswer:
        """Sample scenes from the model. Each sampled scene contains the given objects."""
        return await self._call(calls.GENERATE.call(objects, fields, self.options.model), timeout)

    async def relations_batch(
        self, scenes: Iterable[Scene[schemas.RelationsRequest]], *, timeout: float | None = None
    ) -> schemas.BatchAnswer[schemas.RelationsAnswer]:
        """Ask `relations` about up to 256 scenes. Each scene has its own answer or problem."""
        return await self._call(calls.RELATIONS.batch(scenes, self.options.model), timeout)

    async def missing_batch(
        self, scenes: Iterable[Scene[schemas.MissingRequest]], *, timeout: float | None = None
    ) -> schemas.BatchAnswer[schemas.MissingAnswer]:
        """Ask `missing` about up to 256 scenes. Each scene has its own answer or problem."""
        return await self._call(calls.MISSING.batch(scenes, self.options.model), timeout)

    async def outliers_batch(
        self, scenes: Iterable[Scene[schemas.OutliersRequest]], *, timeout: float | None = None
    ) -> schemas.BatchAnswer[schemas.OutliersAnswer]:
        """Ask `outliers` about up to 256 scenes. Each scene has its own answer or problem."""
        return await self._call(calls.OUTLIERS.batch(scenes, self.options.model), timeout)

    async def rooms_batch(
        self, scenes: Iterable[Scene[schemas.RoomsRequest]], *, timeout: float | None = None
    ) -> schemas.BatchAnswer[schemas.RoomsAnswer]:
        """Ask `rooms` about up to 256 scenes. Each scene has its own answer or problem."""
        return await self._call(calls.ROOMS.batch(scenes, self.options.model), timeout)

    async def where(
        self,
        label: str,
        rooms: Iterable[schemas.HomeRoom | schemas.Body],
        *,
        timeout: float | None = None,
        **fields: Unpack[schemas.WhereFields],
    ) -> schemas.WhereAnswer:
        """Return the likely rooms and places of one thing in a home."""
        return await self._call(calls.where(label, rooms, fields, self.options.model), timeout)

    async def where_batch(
        self,
        requests: Iterable[schemas.WhereRequest | schemas.Body],
        *,
        timeout: float | None = None,
    ) -> schemas.BatchAnswer[schemas.WhereAnswer]:
        """Ask `where` up to 256 times. Each request has its own answer or problem."""
        return await self._call(calls.where_batch(requests, self.options.model), timeout)

    async def models(self, *, timeout: float | None = None) -> schemas.ModelList:
        """Return the models of the service, their versions and their aliases."""
        return await self._call(Call("GET", "/models", schemas.ModelList), timeout)

    @overload
    async def model(self, name: str, *, timeout: float | None = None) -> schemas.ModelSummary: ...

    @overload
    async def model(
        self, name: str, version: str, *, timeout: float | None = None
    ) -> schemas.VersionDetails: ...

    async def model(
        self, name: str, version: str | None = None, *, timeout: float | None = None
    ) -> schemas.ModelSummary | schemas.VersionDetails:
        """Return the versions of a model, or the details of one version."""
        if version is None:
            path = calls.model_path(name)
            return await self._call(Call("GET", path, schemas.ModelSummary), timeout)
        path = calls.model_path(name, "versions", version)
        return await self._call(Call("GET", path, schemas.VersionDetails), timeout)

    async def vocabulary(
        self, name: str | None = None, *, timeout: float | None = None
    ) -> schemas.VocabularyAnswer:
        """Return the object classes, relations and room types of a model."""
        path = calls.model_path(name or self.options.model or "default", "vocabulary")
        return await self._call(Call("GET", path, schemas.VocabularyAnswer), timeout)

    async def word(
        self, word: str, name: str | None = None, *, timeout: float | None = None
    ) -> schemas.WordAnswer:
        """Return the class that a label becomes in a model, and by which rule."""
        path = calls.model_path(name or self.options.model or "default", "vocabulary", word)
        return await self._call(Call("GET", path, schemas.WordAnswer), timeout)

    async def is_live(self, *, timeout: float | None = None) -> bool:
        """Return whether the service answers a health check. The client does not retry."""
        return await self._is("live", timeout)

    async def is_ready(self, *, timeout: float | None = None) -> bool:
        """Return whether the default model of the service is ready. The client does not retry."""
        return await self._is("ready", timeout)

    async def check_ready(self, *, timeout: float | None = None) -> None:
        """Check that the default model of the service is ready. The client does not retry.

        Raises:
            UnreachableError, DeadlineError, ProblemError: the default model is not ready.
        """
        await self._call(Call("GET", "/health/ready", schemas.Health), timeout, retries=0)

    async def _is(self, health: str, timeout: float | None) -> bool:
        try:
            await self._call(Call("GET", f"/health/{health}", schemas.Health), timeout, retries=0)
        except (UnreachableError, DeadlineError):
            return False
        except ProblemError as problem:
            if problem.status != 503:
                raise
            return False
        return True

    async def _call(self, call: Call[T], timeout: float | None, retries: int | None = None) -> T:
        """Return the answer of a call. Retry as long as the timeout allows."""
        retries = self.options.retries if retries is None else retries
        limit = self.options.limit(timeout)
        message = f"The answer did not arrive within {limit:g} s."
        end, attempt = monotonic() + limit, 0
        while (left := end - monotonic()) > 0:
            try:
                answer = await self._attempt(call, left)
            except (TimeoutError, httpx.TimeoutException):
                break
            except DeadlineError as error:
                raise DeadlineError(f"{message} {error}", error.request_id) from None
            except (ProblemError, UnreachableError) as error:
                pause = call.retry_pause(error, attempt)
                if pause is None or attempt == retries or pause >= end - monotonic():
                    raise
                attempt += 1
                await anyio.sleep(pause)
            else:
                # If the client has read the answer only after the deadline, the call fails.
                if monotonic() < end:
                    if self._recorder is not None:
                        self._recorder.record(call.answered(answer))
                    return answer
        raise DeadlineError(message)

    async def _attempt(self, call: Call[T], left: float) -> T:
        """Send a call once and return the answer. The attempt takes at most `left` seconds."""
        options, body = self.options, bytearray()
        with async_deadline(left):
            try:
                async with self._http.stream(
                    call.method,
                    options.url.rstrip("/") + call.path,
                    content=call.body,
                    headers=options.headers(call, left),
                    timeout=left,
                ) as response:
                    async for part in response.aiter_bytes():
                        body += part
                        if len(body) > MAX_ANSWER:
                            raise AnswerError(f"The answer has more than {MAX_ANSWER} bytes.")
            except httpx.TimeoutException:
                raise
            except httpx.TransportError as error:
                raise options.unreachable(error) from error
        return call.read(response.status_code, response.headers, bytes(body))

    async def close(self) -> None:
        """Close all connections, and wait until the recorder has written its scenes."""
        await self._http.aclose()
        if self._recorder is not None:
            self._recorder.flush()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()
