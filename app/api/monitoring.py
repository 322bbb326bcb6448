"""Metrics for Prometheus."""

from __future__ import annotations

import asyncio

from fastapi import APIRouter
from fastapi.responses import PlainTextResponse

from app.api.models import RuntimeDep
from app.api.openapi import problems
from app.serving.metrics import CONTENT_TYPE

router = APIRouter(tags=["monitoring"])


@router.get(
    "/metrics",
    summary="Metrics for Prometheus",
    response_class=PlainTextResponse,
    responses=problems(),
)
async def show_metrics(runtime: RuntimeDep) -> PlainTextResponse:
    """Return counters, gauges and histograms in the text format of Prometheus.

    docs/operations.md explains each metric.
    """
    # The formatting runs in a thread, because it takes more than 10 ms for many series.
    text = await asyncio.to_thread(runtime.metrics.exposition)
    return PlainTextResponse(text, media_type=CONTENT_TYPE)
