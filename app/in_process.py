"""An httpx transport that runs the service in the process of the client."""

from __future__ import annotations

import asyncio
import secrets
import weakref
from concurrent.futures import Future
from pathlib import Path
from threading import Thread

import httpx
from fastapi import FastAPI
from pydantic import SecretStr, ValidationError

from app.main import create_app
from app.settings import Settings
from scene_client.errors import InvalidRequestError


class _FixedSettings(Settings):
    """Settings without environment variables, which configure only separate processes."""

    reads_environment = False


class InProcess(httpx.BaseTransport):
    """Transport that runs the application on its own event loop in its own thread.

    Args:
        store: directory of published models.

    Attributes:
        admin_key: random key for the administration routes of this application.

    Raises:
        InvalidRequestError: the store is not a directory.
    """

    def __init__(self, store: Path) -> None:
        self.admin_key = secrets.token_hex()
        try:
            settings = _FixedSettings(
                store=store,
                admin_key=SecretStr(self.admin_key),
                metrics=False,
                access_log=False,
                docs=False,
                allowed_hosts=("*",),
            )
        except ValidationError:  # of the store, because all other values are fixed
            raise InvalidRequestError.about("the store must be an existing directory") from None
        app = create_app(settings)
        self._asgi = httpx.ASGITransport(app, raise_app_exceptions=False)
        loop_future: Future[asyncio.AbstractEventLoop] = Future()
        stop = asyncio.Event()
        thread = Thread(target=_run, args=(app, loop_future, stop), daemon=True, name="scene")
        thread.start()
        self._loop = loop_future.result()  # waits until the application has started
        # The finalizer ends the thread when the transport is closed or deleted, or at program exit.
        self._finalize = weakref.finalize(self, _stop, self._loop, stop, thread)

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        """Send one request to the application and return its response."""
        future = asyncio.run_coroutine_threadsafe(self._answer(request), self._loop)
        try:
            return future.result(request.extensions["timeout"]["read"])
        except TimeoutError:
            future.cancel()
            raise httpx.ReadTimeout("the timeout has expired", request=request) from None

    async def _answer(self, request: httpx.Request) -> httpx.Response:
        response = await self._asgi.handle_async_request(request)
        # The caller runs on another thread, so this event loop must read the whole body.
        body = await response.aread()
        return httpx.Response(response.status_code, headers=response.headers, content=body)

    def close(self) -> None:
        """End the application and its thread."""
        self._finalize()


def _run(app: FastAPI, loop_future: Future[asyncio.AbstractEventLoop], stop: asyncio.Event) -> None:
    """Run the application on a new event loop until ``stop`` is set.

    After the start, ``loop_future`` contains the event loop. If the start fails, it contains the
    error.
    """

    async def run_until_stop() -> None:
        async with app.router.lifespan_context(app):
            loop_future.set_result(asyncio.get_running_loop())
            await stop.wait()

    try:
        asyncio.run(run_until_stop())
    except BaseException as error:
        if loop_future.done():
            raise
        loop_future.set_exception(error)


def _stop(loop: asyncio.AbstractEventLoop, stop: asyncio.Event, thread: Thread) -> None:
    loop.call_soon_threadsafe(stop.set)
    thread.join()
