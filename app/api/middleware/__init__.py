"""Plain ASGI middleware, one of them a module.

None of it derives from `BaseHTTPMiddleware`, three of which cost three quarters of the throughput.
"""

from __future__ import annotations

from collections.abc import Callable

from fastapi import FastAPI

from app.api.middleware.body_limit import BodyLimit
from app.api.middleware.context import RequestContext
from app.api.middleware.defects import Defects
from app.api.middleware.headers import SafeHeaders
from app.api.middleware.hosts import HostGuard
from app.api.middleware.key_guard import KeyGuard
from app.api.middleware.origins import CrossOrigin
from app.api.middleware.turnstile import Turnstile
from app.serving.metrics import Metrics
from app.settings import Settings


def install(
    app: FastAPI,
    settings: Settings,
    metrics: Metrics,
    backlog: Callable[[], int] = lambda: 0,
    is_draining: Callable[[], bool] = lambda: False,
) -> None:
    """Add all of it to an application, from the inside out.

    Args:
        backlog: how many of the requests begun are still worked for.
        is_draining: whether nothing new is to be begun.
    """
    app.add_middleware(
        BodyLimit,
        limit=settings.max_body_bytes,
        budget=settings.held_body_bytes,
        patience=settings.client_timeout,
    )
    app.add_middleware(
        Turnstile,
        limit=settings.queue_requests,
        timeout=settings.request_timeout_ms / 1e3,
        longest_ms=settings.max_request_timeout_ms,
        backlog=backlog,
        is_draining=is_draining,
    )
    # Outside these: a stranger's request takes no place, and not even its size is judged.
    if settings.api_key is not None:
        app.add_middleware(KeyGuard, api_key=settings.api_key, admin_key=settings.admin_key)
    # Inside of all that adds to answers: those of defects carry id and headers as any other.
    app.add_middleware(Defects)
    if settings.cors_origins:
        app.add_middleware(CrossOrigin, origins=settings.cors_origins)
    if (hosts := settings.accepted_hosts) is not None:
        app.add_middleware(HostGuard, hosts=hosts)
    app.add_middleware(SafeHeaders)
    app.add_middleware(RequestContext, metrics=metrics, access_log=settings.access_log)
