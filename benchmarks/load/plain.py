"""``python -m benchmarks.load.plain PORT``: a minimal FastAPI app as reference for the load test.

The app validates requests with the request models of the service and returns a prepared answer. It
computes no answers, and has no middleware, metrics or log.
"""

from __future__ import annotations

import sys

import uvicorn
from fastapi import FastAPI, Request, Response

from scene_client.schemas import MissingRequest, OutliersRequest, RelationsRequest, RoomsRequest

app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
_answers: dict[str, bytes] = {}


@app.put("/answers/{question}")
async def prepare(question: str, request: Request) -> None:
    """Store the body of the request as the answer to all later requests of a question."""
    _answers[question] = await request.body()


@app.post("/relations")
async def relations(_: RelationsRequest) -> Response:
    return Response(_answers["relations"], media_type="application/json")


@app.post("/missing")
async def missing(_: MissingRequest) -> Response:
    return Response(_answers["missing"], media_type="application/json")


@app.post("/outliers")
async def outliers(_: OutliersRequest) -> Response:
    return Response(_answers["outliers"], media_type="application/json")


@app.post("/rooms")
async def rooms(_: RoomsRequest) -> Response:
    return Response(_answers["rooms"], media_type="application/json")


@app.get("/health/ready")
async def ready() -> dict[str, str]:
    return {"status": "ready"}


if __name__ == "__main__":
    uvicorn.run(
        app, port=int(sys.argv[1]), http="httptools", access_log=False, log_level="critical"
    )
