"""The served models: verified by the registry, warmed up here, replaced as a whole.

A snapshot of the models never changes, so a request uses the same models from beginning to end. A
refused version stays listed with its reason, and an older version never replaces it.
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
    """A model that has passed its warm-up.

    Attributes:
        artifact: weights, vocabulary and calibration.
        queue: the work of this model.
    """

    artifact: Artifact
    queue: WorkQueue

    @cached_property
    def reference(self) -> ModelReference:
        """The name, version, variant and digest in answers."""
        manifest = self.artifact.manifest
        return ModelReference(
            name=manifest.name,
            version=manifest.version,
            variant=manifest.variant,
            digest=self.artifact.digest,
        )

    @cached_property
    def key(self) -> Key:
        """Name and version."""
        return self.artifact.manifest.name, self.artifact.manifest.version

    @cached_property
    def vocabulary(self) -> Vocabulary:
        """Object classes and room types."""
        return self.artifact.vocabulary

    @cached_property
    def context_sizes(self) -> Mapping[str, int]:
        """Number of units of each hidden layer."""
        spec = self.artifact.spec
        return {"h1": spec.H1, "h2": spec.H2} if spec.H2 else {"h1": spec.H1}

    @cached_property
    def contexts(self) -> Mapping[str, tuple[questions.ContextUnit, ...]]:
        """Hidden units of each layer, with their strongest objects and relations.

        The first access takes 0.2 s.
        """
        return questions.contexts(self.artifact)


@dataclass(frozen=True, eq=False)
class ServedModels:
    """A snapshot of served models, refused versions and aliases.

    Attributes:
        store: snapshot of the registry.
        served: models that have passed their warm-up, by (name, version).
        warm_up_failures: verified models that failed their warm-up, with reasons.
    """

    store: ModelSet
    served: Mapping[Key, ServedModel]
    warm_up_failures: Mapping[Key, Failure]

    def resolve(self, reference: str) -> ServedModel:
        """Return the model of an alias, `name` or `name@version`.

        Raises:
            UnknownModelError: the alias, model or version does not exist.
            ModelUnavailableError: the version was refused, or the target of the alias is missing.
            NotReadyError: the default model is not usable.
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
                raise UnknownModelError("This alias, model or version does not exist.") from None
            raise ModelUnavailableError("The service refused to load this model.") from None

    def with_alias(self, alias: str, target: AliasTarget) -> ServedModels:
        """Return a copy of the snapshot in which an alias has another target."""
        aliases = MappingProxyType({**self.store.aliases, alias: target})
        return replace(self, store=replace(self.store, aliases=aliases))

    @cached_property
    def _resolved(self) -> dict[str, ServedModel]:
        # Only valid references, whose number the store limits. Clients can invent invalid ones.
        return {}

    @cached_property
    def usable(self) -> frozenset[str]:
        """Names without a failure: versions (``name@version``), aliases and "store"."""
        versions = {f"{name}@{version}" for name, version in self.served}
        subjects = versions | self.store.aliases.keys() | {DEFAULT, "store"}
        return frozenset(subjects - self.failures.keys())

    @cached_property
    def generation(self) -> str:
        """Digest of the served versions and aliases, equal in replicas with the same state."""
        versions = {"@".join(key): model.artifact.digest for key, model in self.served.items()}
        aliases = {alias: str(target) for alias, target in self.store.aliases.items()}
        text = json.dumps([versions, aliases], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @cached_property
    def failures(self) -> Mapping[str, Failure]:
        """Failures by subject: version (``name@version``), alias or "store"."""
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
