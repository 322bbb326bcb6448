"""Routes that list the models, their versions and their vocabularies."""

import math
from dataclasses import asdict
from functools import partial
from typing import Annotated, Final, cast
from weakref import WeakKeyDictionary

from fastapi import APIRouter, Depends, Path
from starlette.requests import Request
from starlette.responses import Response

from app.api.openapi import error_responses
from app.errors import InvalidRequestError
from app.model.scene_model import SceneModel
from app.registry import Artifact
from app.registry.manifest import of_machine
from app.scene.spatial_relations import relation_names
from app.serving.models import ServedModels
from app.serving.runtime import Runtime
from scene_client import schemas
from scene_client.schemas.requests import MAX_LABEL

_ERRORS: Final = error_responses("admission", "models", "name")
_LOADED_ERRORS: Final = error_responses("admission", "models", "name", "model")

Reference = Annotated[
    str,
    Path(
        description="an alias, `name` (the newest usable version of a model) or `name@version`",
        openapi_examples={"alias": {"summary": "the default model", "value": "default"}},
    ),
]
Word = Annotated[
    str,
    Path(
        description=f"a label of an object with at most {MAX_LABEL} characters",
        openapi_examples={"alias": {"summary": "an alias", "value": "bedside cabinet"}},
    ),
]
Version = Annotated[str, Path(description="a version that GET /models lists")]


# `_runtime` is a coroutine, because FastAPI runs plain functions in a thread. This takes 100 µs.
async def _runtime(http: Request) -> Runtime:
    runtime: Runtime = http.app.state.runtime
    return runtime


RuntimeDep = Annotated[Runtime, Depends(_runtime)]

router = APIRouter(prefix="/models", tags=["models"])
_get = partial(router.get, response_model_exclude_none=True)

# A vocabulary never changes, and its JSON takes milliseconds.
_VOCABULARIES: Final[WeakKeyDictionary[Artifact, str]] = WeakKeyDictionary()


@_get("", summary="Models, versions and aliases", responses=error_responses("admission", "models"))
async def list_models(runtime: RuntimeDep) -> schemas.ModelList:
    """List the models, versions and aliases of the store. Each refused version has a reason."""
    models = runtime.models
    return schemas.ModelList(
        generation=models.generation,
        models=[_summary(models, name) for name in models.store.versions],
        aliases={alias: str(target) for alias, target in sorted(models.store.aliases.items())},
        failures=list(models.failures.values()),
    )


@_get("/{name}", summary="One model", responses=_ERRORS)
async def show_model(name: Reference, runtime: RuntimeDep) -> schemas.ModelSummary:
    """List the versions of a model, newest version first."""
    return _summary(runtime.models, _name(runtime.models, name))


@_get("/{name}/versions/{version}", summary="One version of a model", responses=_ERRORS)
async def show_version(
    name: Reference, version: Version, runtime: RuntimeDep
) -> schemas.VersionDetails:
    """Return metrics, training data, terms and model card of a version, or why it is refused."""
    models = runtime.models
    name = _name(models, name)
    if version not in models.store.versions[name]:
        raise models.unknown(f"{name}@{version}")
    details = dict(_version_summary(models, name, version), name=name)
    if (served := models.served.get((name, version))) is not None:
        weights = of_machine(served.manifest.tensors)
        details["parameters"] = sum(math.prod(entry.shape) for entry in weights.values())
        details["card"] = served.card
        details |= served.manifest.model_dump(include={"created", "metrics", "data", "terms"})
    return schemas.VersionDetails(**details)


@router.get(
    "/{name}/vocabulary",
    summary="The vocabulary of a model",
    response_model=schemas.VocabularyAnswer,
    responses=_LOADED_ERRORS,
)
async def show_vocabulary(name: Reference, runtime: RuntimeDep) -> Response:
    """List the object classes with their aliases, the relations and the room types of a model."""
    served = runtime.models.resolve(name)
    if served not in _VOCABULARIES:
        _VOCABULARIES[served] = _vocabulary(served).model_dump_json()
    return Response(_VOCABULARIES[served], media_type="application/json")


@_get(
    "/{name}/vocabulary/{word:path}",
    summary="The class of a label",
    responses=_LOADED_ERRORS | {422: error_responses("word")[422]},
)
async def show_word(
    http: Request, name: Reference, word: Word, runtime: RuntimeDep
) -> schemas.WordAnswer:
    """Return the class that a label of an object becomes, and by which rule."""
    if len(word) > MAX_LABEL:
        raise InvalidRequestError(detail=f"A label has at most {MAX_LABEL} characters.")
    served = runtime.models.resolve(name)
    vocabulary = served.model.vocabulary

    def look_up(_: object) -> schemas.WordAnswer:
        """Return the class of the label, or the nearest classes if no rule finds one."""
        answer = partial(schemas.WordAnswer, model=served.reference, word=word)
        reading = vocabulary.look_up(word)
        if reading is None:
            matches = vocabulary.nearest(word)
            return answer(suggestions=[vocabulary.labels[match.entry] for match in matches])
        entry = _class(served.model, reading.entry)
        return answer(class_=entry, rule=reading.rule, certain=reading.is_certain)

    # A guess compares the label with all names, which takes milliseconds.
    return await runtime.admission.in_worker(http.state.ticket, look_up)


def _vocabulary(served: Artifact) -> schemas.VocabularyAnswer:
    manifest, model = served.manifest, served.model
    vocabulary, calibration = model.vocabulary, model.calibration
    relations, rooms = relation_names(model.spec.A), vocabulary.room_types
    return schemas.VocabularyAnswer(
        model=served.reference,
        objects=[_class(model, index) for index in range(len(vocabulary.objects))],
        relations=[cast("schemas.RelationName", name) for name in relations],
        room_types=list(rooms),
        rare_room_types=[rooms[t] for t in calibration.rare_rooms],
        written_room_types=[rooms[t] for t in calibration.written_rooms],
        profiles=list(manifest.vocabulary.profiles),
        examples=[
            schemas.ExampleScene(name=example.name, scene=example.request())
            for example in manifest.examples
        ],
    )


def _class(model: SceneModel, index: int) -> schemas.VocabularyEntry:
    entry = model.vocabulary.objects[index]
    size = entry.size and dict(zip("xyz", entry.size, strict=True))
    hangs = model.places is not None and bool(model.places.hanging[index])
    return schemas.VocabularyEntry(**asdict(entry) | {"size": size, "hangs": hangs})


def _name(models: ServedModels, reference: str) -> str:
    """Return the model name of a reference, even if the service refused the version."""
    name = reference.partition("@")[0]
    name = models.store.aliases[name].name if name in models.store.aliases else name
    if name not in models.store.versions:
        raise models.unknown(reference)
    return name


def _summary(models: ServedModels, name: str) -> schemas.ModelSummary:
    versions = reversed(models.store.versions[name])
    entries = [_version_summary(models, name, version) for version in versions]
    return schemas.ModelSummary(name=name, versions=entries)


def _version_summary(models: ServedModels, name: str, number: str) -> schemas.VersionSummary:
    """Return aliases, variant and digest of a version, or why the service refused it."""
    served = models.served.get((name, number))
    if served is None:
        failure = models.failures[f"{name}@{number}"]
        cause = {"reason": failure.reason, "detail": failure.detail}
        return schemas.VersionSummary(version=number, status="refused", aliases=[], **cause)
    return schemas.VersionSummary(
        version=number,
        status="ready",
        aliases=models.aliases[name, number],
        variant=served.reference.variant,
        digest=served.reference.digest,
    )
