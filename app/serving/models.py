"""The models being served: verified by the registry, warmed here, swapped as a whole.

A snapshot never changes, so a request that holds one sees one state of the world from beginning to
end. Nothing that was refused hides: it stays listed with its reason, and no older version answers
in its place.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType

from app import questions
from app.registry import AliasTarget, Artifact, ArtifactError, ModelSet, StoreError
from app.scene.vocabulary import Vocabulary
from app.serving.admission import WorkQueue
from app.serving.errors import ModelUnavailableError, NotReadyError, UnknownModelError
from scene_client.schemas import Failure, ModelReference

DEFAULT = "default"
Key = tuple[str, str]

_logger = logging.getLogger("app.serving")
_UNKNOWN = {"unknown_model", "unknown_version", "invalid_reference"}


@dataclass(frozen=True, eq=False)
class ServedModel:
    """A model that has answered.

    Attributes:
        artifact: what the reasoning works with.
        queue: its work.
    """

    artifact: Artifact
    queue: WorkQueue

    @cached_property
    def reference(self) -> ModelReference:
        """How answers name it."""
        manifest = self.artifact.manifest
        return ModelReference(
            name=manifest.name,
            version=manifest.version,
            variant=manifest.variant,
            digest=self.artifact.digest,
        )

    @cached_property
    def key(self) -> Key:
        """Its name and version."""
        return self.artifact.manifest.name, self.artifact.manifest.version

    @cached_property
    def vocabulary(self) -> Vocabulary:
        """Its words."""
        return self.artifact.vocabulary

    @cached_property
    def context_sizes(self) -> Mapping[str, int]:
        """How many units each layer has."""
        spec = self.artifact.spec
        return {"h1": spec.H1, "h2": spec.H2} if spec.H2 else {"h1": spec.H1}

    @cached_property
    def contexts(self) -> Mapping[str, tuple[questions.ContextUnit, ...]]:
        """Its hidden units by their strongest objects and relations, layer by layer.

        Takes a fifth of a second the first time.
        """
        return questions.contexts(self.artifact)


@dataclass(frozen=True, eq=False)
class ServedModels:
    """A snapshot: what is served, what was refused, and the aliases.

    Attributes:
        store: the registry's snapshot.
        served: the models that have answered, by (name, version).
        warm_up_failures: verified models that could not answer, and why.
    """

    store: ModelSet
    served: Mapping[Key, ServedModel]
    warm_up_failures: Mapping[Key, Failure]

    def resolve(self, reference: str) -> ServedModel:
        """The model that an alias, `name` or `name@version` leads to.

        Raises:
            UnknownModelError: no such model or version.
            ModelUnavailableError: it was refused, or the alias leads nowhere.
            NotReadyError: the same of the default.
        """
        found = self._resolved.get(reference)
        if found is not None:
            return found
        try:
            artifact = self.store.resolve(reference)
            found = self.served[artifact.manifest.name, artifact.manifest.version]
            self._resolved[reference] = found
            return found
        except (StoreError, ArtifactError, KeyError) as error:
            if reference == DEFAULT:
                raise NotReadyError("The default model is not usable.") from None
            if isinstance(error, StoreError) and error.code in _UNKNOWN:
                raise UnknownModelError("There is no such alias, model or version.") from None
            raise ModelUnavailableError("This model was refused when it was loaded.") from None

    def with_alias(self, alias: str, target: AliasTarget) -> ServedModels:
        """The same snapshot with one alias moved."""
        aliases = MappingProxyType({**self.store.aliases, alias: target})
        return replace(self, store=replace(self.store, aliases=aliases))

    @cached_property
    def _resolved(self) -> dict[str, ServedModel]:
        # Successes only: clients choose the references, the store bounds those that lead somewhere.
        return {}

    @cached_property
    def usable(self) -> frozenset[str]:
        """What works: versions as ``name@version``, aliases, and the store, as ``failures`` do."""
        versions = {f"{name}@{version}" for name, version in self.served}
        subjects = versions | self.store.aliases.keys() | {DEFAULT, "store"}
        return frozenset(subjects - self.failures.keys())

    @cached_property
    def generation(self) -> str:
        """The same in all replicas that serve the same versions under the same aliases."""
        versions = {"@".join(key): model.artifact.digest for key, model in self.served.items()}
        aliases = {alias: str(target) for alias, target in self.store.aliases.items()}
        text = json.dumps([versions, aliases], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @cached_property
    def failures(self) -> Mapping[str, Failure]:
        """Everything that cannot be used, by subject: versions, aliases, the store itself."""
        found = {
            f"{name}@{version}": Failure(
                subject=f"{name}@{version}", reason=refused.code, detail=refused.reason
            )
            for (name, version), refused in self.store.failures.items()
        }
        found |= {failure.subject: failure for failure in self.warm_up_failures.values()}
        for alias in sorted({DEFAULT, *self.store.aliases}):
            try:
                self.resolve(alias)
            except (UnknownModelError, ModelUnavailableError, NotReadyError):
                found[alias] = self._alias_failure(alias)
        if self.store.failure is not None:
            found["store"] = Failure(
                subject="store", reason=self.store.failure.code, detail=self.store.failure.reason
            )
        return found

    def _alias_failure(self, alias: str) -> Failure:
        try:
            artifact = self.store.resolve(alias)
        except (StoreError, ArtifactError) as error:
            return Failure(subject=alias, reason=error.code, detail=error.reason)
        name, version = artifact.manifest.name, artifact.manifest.version
        cause = self.warm_up_failures[name, version]
        return Failure(subject=alias, reason=cause.reason, detail=f"{name}@{version}")
