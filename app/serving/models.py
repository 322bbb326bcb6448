"""The served models: the registry has verified them, and the service has warmed them up.

A snapshot of the models never changes, so a request uses the same models from beginning to end.
"""

import hashlib
import json
import logging
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Self

from app import errors
from app.questions import QUESTIONS, alternatives, conventions, several_rooms
from app.questions.answer import written
from app.registry import Artifact, ArtifactError, ModelSet, StoreError
from app.registry.model_set import EMPTY
from app.scene.nearest import spelt_alike
from app.scene.relation_table import RelationTable
from app.scene.scene import Scene, SceneObject, observe
from app.scene.spatial_relations import ON_TOP
from app.scene.vocabulary import Vocabulary
from scene_client.schemas import Failure

DEFAULT = "default"
Key = tuple[str, str]

_logger = logging.getLogger("app.serving")
_UNKNOWN = {"unknown_model", "unknown_version", "invalid_reference"}


@dataclass(frozen=True, eq=False)
class ServedModels:
    """A snapshot of served models, refused versions and aliases, including failed warm-ups."""

    store: ModelSet

    @property
    def served(self) -> Mapping[Key, Artifact]:
        """Maps the (name, version) of each usable model to its artifact."""
        return self.store.artifacts

    def resolve(self, reference: str) -> Artifact:
        """Return the model that an alias, `name` or `name@version` points at.

        If the target of the alias `default` is not usable, this alias points at the newest usable
        version of the target's model. If only earlier releases could load the target of an alias,
        the alias points at the default model of the release.

        Raises:
            UnknownModelError: the alias, model or version does not exist.
            ModelReplacedError: the release has another model instead.
            ModelUnavailableError: the service refused the version, or the store lacks the target of
                the alias.
            NotReadyError: the default model is not usable.
        """
        if (cached := self._resolved.get(reference)) is not None:
            return cached
        try:
            model = self._resolved[reference] = self._find(reference)
        except (StoreError, ArtifactError) as error:
            if reference == DEFAULT:
                raise errors.NotReadyError("The default model is not usable.") from None
            name = reference.partition("@")[0]
            if error.code == "replaced_model" and name in self.store.shipped.replaced:
                raise self._replaced(name) from None
            if isinstance(error, StoreError) and error.code in _UNKNOWN:
                raise self.unknown(reference) from None
            detail = f"The service refused to load this model: {error.reason}."
            raise errors.ModelUnavailableError(detail) from None
        return model

    def _find(self, reference: str) -> Artifact:
        """Return the model of a reference, or the substitute for an unusable target of an alias."""
        try:
            return self.store.resolve(reference)
        except (StoreError, ArtifactError):
            target, default = self.store.aliases.get(reference), self.store.shipped.default
            if target is None:
                raise
            if reference == DEFAULT:
                with suppress(StoreError, ArtifactError):
                    return self.store.resolve(target.name)
            if default is None or not self.store.is_outdated(reference):
                raise
            return self.store.resolve(str(default))

    def unknown(self, reference: str) -> errors.ServiceError:
        """Return the error for a reference to nothing. The error lists the known names."""
        name = reference.partition("@")[0]
        target = self.store.aliases.get(name)
        versions = self.store.versions.get(name if target is None else target.name)
        if versions:
            detail = f"This model has no such version. Its versions: {errors.some_of(versions)}."
            return errors.UnknownModelError(detail)
        if name in self.store.shipped.replaced:
            return self._replaced(name)
        similar = spelt_alike(name, sorted({*self.store.aliases, *self.store.versions}))
        hint = f" Similar names: {', '.join(similar)}." if similar else ""
        aliases, models = errors.some_of(self.store.aliases), errors.some_of(self.store.versions)
        return errors.UnknownModelError(
            f"No model or alias has this name.{hint} Aliases: {aliases}. Models: {models}."
        )

    def _replaced(self, name: str) -> errors.ModelReplacedError:
        new = self.store.shipped.replaced[name].by
        located = errors.LocatedError(("model",), f"{new} replaces this model", (new,))
        detail = f"The model {new} replaces the model {name}. GET /models lists all models."
        return errors.ModelReplacedError([located], detail=detail)

    @cached_property
    def _resolved(self) -> dict[str, Artifact]:
        # Only valid references, because clients can send any number of invalid ones.
        return {}

    @cached_property
    def aliases(self) -> Mapping[Key, list[str]]:
        """Maps each served model to the sorted aliases that point at it."""
        aliases: dict[Key, list[str]] = {key: [] for key in self.served}
        for alias in sorted(self.store.aliases):
            with suppress(errors.ServiceError):
                aliases[self.resolve(alias).key].append(alias)
        return aliases

    @property
    def is_ready(self) -> bool:
        """Whether a model answers requests for the alias `default`."""
        try:
            return bool(self.resolve(DEFAULT))
        except errors.NotReadyError:
            return False

    def lost_in(self, new: Self) -> list[Failure]:
        """Return the failures of entries that are usable here and unusable in a newer snapshot."""
        versions = {"@".join(key) for key in self.served}
        lost = {*versions, *self.store.aliases, DEFAULT, "store"} - self.failures.keys()
        if self.is_ready and not new.is_ready:
            lost.add(DEFAULT)
        return [failure for subject, failure in new.failures.items() if subject in lost]

    @cached_property
    def generation(self) -> str:
        """Digest of the served versions and aliases. Equal digests mean equal states."""
        versions = {"@".join(key): model.digest for key, model in self.served.items()}
        aliases = {alias: str(target) for alias, target in self.store.aliases.items()}
        text = json.dumps([versions, aliases], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @cached_property
    def failures(self) -> Mapping[str, Failure]:
        """Maps each unusable alias, "store" or, last, ``name@version`` to its failure."""
        causes: dict[str, ArtifactError | StoreError] = {}
        for alias in sorted({DEFAULT, *self.store.aliases}):
            try:
                self.store.resolve(alias)
            except (StoreError, ArtifactError) as error:
                causes[alias] = error
                with suppress(errors.ServiceError):
                    instead = "@".join(self.resolve(alias).key)
                    reason = f"{error.reason}; {instead} answers instead"
                    causes[alias] = type(error)(error.code, reason)
        if self.store.failure is not None:
            causes["store"] = self.store.failure
        causes |= {"@".join(key): failure for key, failure in self.store.failures.items()}
        return {
            subject: Failure(subject=subject, reason=cause.code, detail=cause.reason)
            for subject, cause in causes.items()
        }


NO_MODELS: Final = ServedModels(EMPTY)
"""The snapshot before the service has loaded its models."""


def warm_up(artifact: Artifact) -> None:
    """Ask each question about three scenes: with relations, without relations, and with poses.

    Raises:
        ArtifactError: `warm_up_failed` if the model could not answer a question.
    """
    model = artifact.model
    related = _scene(model.vocabulary)
    bare = replace(related, relations=None)
    posed = observe(bare, typical_sizes=model.vocabulary.sizes)
    try:
        stands = None if model.places is None else model.places.stands
        conventions.warm_up(model.vocabulary, stands)
        several_rooms.warm_up(model)
        alternatives.warm_up(model, bare)
        for question in QUESTIONS:
            for answer in question.warm_up(model, (related, bare, posed)):
                written(answer)
    except errors.RequestError as error:
        reason = "; ".join(one.message for one in error.located)
        raise ArtifactError("warm_up_failed", reason) from None
    except Exception:
        # A broken model may raise any exception. The service must still serve other models.
        _logger.exception("the warm-up of model %s failed", "@".join(artifact.key))
        reason = "the files are valid, but the model could not answer a question"
        raise ArtifactError("warm_up_failed", reason) from None


def _scene(vocabulary: Vocabulary) -> Scene:
    """Return a scene of up to three boxes in a row. The second object is on top of the first."""
    proposable = [i for i, entry in enumerate(vocabulary.objects) if not entry.structure]
    objects = tuple(
        SceneObject(str(k), vocabulary.labels[index], index, 1.0, (1.0, 0.5 * k, 0.5), (0.3,) * 3)
        for k, index in enumerate((proposable or [0])[:3])
    )
    relations = RelationTable.stated([(ON_TOP, 1, 0)]) if len(objects) > 1 else None
    return Scene(objects, relations)
