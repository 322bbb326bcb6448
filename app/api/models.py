"""What can be asked, and changing it."""

from __future__ import annotations

import asyncio
from typing import Annotated, Final

from fastapi import APIRouter, Depends, Path, Security
from fastapi.security import APIKeyHeader, HTTPBearer
from starlette.requests import Request

from app.api import catalogue
from app.api.body import AdminJSONRoute, check_admin
from app.api.gateway import ADMIN_KEY
from app.api.openapi import queued
from app.serving import describe
from app.serving.runtime import Runtime
from scene_client.schemas import (
    AliasAnswer,
    AliasRequest,
    ContextsAnswer,
    ModelList,
    ModelSummary,
    RefreshAnswer,
    VersionDetails,
    VocabularyAnswer,
)

_PROBLEMS: Final = queued(catalogue.MODEL_NOT_FOUND, catalogue.NOT_READY)
_USABLE: Final = queued(catalogue.MODEL_NOT_FOUND, catalogue.NOT_READY, catalogue.MODEL_UNAVAILABLE)

Reference = Annotated[
    str,
    Path(
        description="an alias, `name` (its newest version) or `name@version`",
        openapi_examples={"alias": {"summary": "the default model", "value": "default"}},
    ),
]
Version = Annotated[str, Path(description="as GET /models lists it")]

# For the documentation alone: a stranger's body is not read, and dependencies are resolved later.
_SCHEMES: Final = [
    Security(APIKeyHeader(name=ADMIN_KEY, scheme_name="admin-key", auto_error=False)),
    Security(HTTPBearer(scheme_name="admin-key-as-bearer-token", auto_error=False)),
]


# A coroutine: the framework runs plain functions in a thread, at 100 µs a hop.
async def _runtime(http: Request) -> Runtime:
    runtime: Runtime = http.app.state.runtime
    return runtime


RuntimeDep = Annotated[Runtime, Depends(_runtime)]

router = APIRouter(prefix="/models", tags=["models"])
administration = APIRouter(prefix="/models", tags=["administration"], dependencies=_SCHEMES)
changes = APIRouter(
    prefix="/models",
    tags=["administration"],
    route_class=AdminJSONRoute,
    dependencies=_SCHEMES,
)


@router.get(
    "",
    summary="Models, versions and aliases",
    responses=queued(catalogue.NOT_READY),
    response_model_exclude_none=True,
)
async def list_models(runtime: RuntimeDep) -> ModelList:
    """Everything in the store, with what was refused and why."""
    return describe.everything(runtime.models)


@router.get("/{name}", summary="One model", responses=_PROBLEMS, response_model_exclude_none=True)
async def show_model(name: Reference, runtime: RuntimeDep) -> ModelSummary:
    """The versions of a model, newest first."""
    return describe.model(runtime.models, name)


@router.get(
    "/{name}/versions/{version}",
    summary="One version of a model",
    responses=_PROBLEMS,
    response_model_exclude_none=True,
)
async def show_version(name: Reference, version: Version, runtime: RuntimeDep) -> VersionDetails:
    """Metrics, data, terms and card of a version; of a refused one, why."""
    return describe.version(runtime.models, name, version)


@router.get("/{name}/vocabulary", summary="The words of a model", responses=_USABLE)
async def show_vocabulary(name: Reference, runtime: RuntimeDep) -> VocabularyAnswer:
    """Object classes with their aliases, relations and room types."""
    return describe.vocabulary(runtime.models.resolve(name))


@router.get("/{name}/contexts", summary="The hidden units of a model", responses=_USABLE)
async def show_contexts(name: Reference, runtime: RuntimeDep) -> ContextsAnswer:
    """Each hidden unit by its strongest objects; `context` of `/generate` names units by number."""
    # In a thread: the first time takes a fifth of a second.
    return await asyncio.to_thread(describe.contexts, runtime.models.resolve(name))


@administration.post(
    "/refresh",
    summary="Take over what the store holds now",
    responses=queued(catalogue.UNAUTHORIZED, catalogue.REFRESH_REFUSED),
    response_model_exclude_none=True,
)
async def refresh_models(http: Request) -> RefreshAnswer:
    """Load, verify and warm everything in the store, then swap it in at once.

    What is served now goes on answering meanwhile, and for good if anything is wrong with the new.
    """
    check_admin(http)
    runtime: Runtime = http.app.state.runtime
    return await runtime.refresh(http.state.request_id)


@changes.put(
    "/aliases/{alias}",
    summary="Promote or roll back",
    responses=queued(
        catalogue.NOT_JSON,
        catalogue.UNAUTHORIZED,
        catalogue.MODEL_NOT_FOUND,
        catalogue.ALIAS_CONFLICT,
        catalogue.MODEL_UNUSABLE,
        catalogue.REFRESH_REFUSED,
        catalogue.STORE_NOT_WRITABLE,
        catalogue.STORE_BUSY,
        catalogue.REQUEST_TIMEOUT,
        catalogue.BODY_TOO_LARGE,
        catalogue.BODIES_FULL,
        catalogue.UNSUPPORTED_MEDIA_TYPE,
        catalogue.INVALID_REQUEST,
        catalogue.NOT_READY,
    ),
    response_model=AliasAnswer,
)
async def move_alias(
    alias: Annotated[
        str,
        Path(
            description="`default`, or any name of your own",
            openapi_examples={"default": {"summary": "the default model", "value": "default"}},
        ),
    ],
    asked: AliasRequest,
    http: Request,
) -> bytes:
    """Let an alias lead to a version that is served; the store remembers it."""
    runtime: Runtime = http.app.state.runtime
    answer = await runtime.move_alias(alias, asked, http.state.request_id)
    return answer.model_dump_json(exclude_none=True).encode()
