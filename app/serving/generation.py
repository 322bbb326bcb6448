"""What is served, said so exactly that another process can serve the very same."""

from __future__ import annotations

from collections.abc import Callable
from types import MappingProxyType

from pydantic import BaseModel, ConfigDict

from app.registry import (
    AliasTarget,
    Artifact,
    ArtifactError,
    ArtifactFailure,
    ModelSet,
    Store,
    StoreError,
    StoreFailure,
)
from app.schemas import Failure
from app.serving.errors import RefreshRefusedError
from app.serving.models import Key, ServedModels, prepare
from app.serving.queue import WorkQueue


class Generation(BaseModel):
    """A snapshot without its weights.

    Two workers whose generations are equal give the same answers, those about models included.

    Attributes:
        digests: of every version that verified, by ``name@version``.
        refused: the versions that did not, and why.
        unanswered: the verified versions that could not answer a question.
        aliases: what each points at.
        failure: set where the store or its aliases could not be read.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    digests: dict[str, str]
    refused: dict[str, ArtifactFailure]
    unanswered: dict[str, Failure]
    aliases: dict[str, AliasTarget]
    failure: StoreFailure | None

    @classmethod
    def of(cls, models: ServedModels) -> Generation:
        """The generation of a snapshot; its members are sorted, so equal ones are equal as text."""
        store = models.store
        return cls(
            digests={
                _reference(key): entry.digest
                for key, entry in sorted(store.entries.items())
                if isinstance(entry, Artifact)
            },
            refused={_reference(key): entry for key, entry in sorted(store.failures.items())},
            unanswered={
                _reference(key): failure for key, failure in sorted(models.warm_up_failures.items())
            },
            aliases=dict(sorted(store.aliases.items())),
            failure=store.failure,
        )


def restore(
    generation: Generation,
    store: Store,
    new_queue: Callable[[], WorkQueue],
    previous: ServedModels | None = None,
) -> ServedModels:
    """Load, verify and warm exactly what a generation names, whatever else the store holds by now.

    Args:
        generation: what others serve, or are about to.
        store: where the versions lie.
        new_queue: for each model that is not taken over.
        previous: a snapshot whose models are taken over where their digests are the same: they need
            not be in the store any longer.

    Raises:
        RefreshRefusedError: something of it cannot be had; `failures` says what.
    """
    failures: list[Failure] = []
    entries: dict[Key, Artifact | ArtifactFailure] = {
        _key(reference): failure for reference, failure in generation.refused.items()
    }
    known = previous.store.entries if previous is not None else {}
    for reference, digest in generation.digests.items():
        key = _key(reference)
        artifact = known.get(key)
        try:
            if not (isinstance(artifact, Artifact) and artifact.digest == digest):
                artifact = store.load(*key)
        except (ArtifactError, StoreError) as error:
            failures.append(Failure(subject=reference, reason=error.code, detail=error.reason))
            continue
        if artifact.digest != digest:
            failures.append(
                Failure(
                    subject=reference,
                    reason="checksum_mismatch",
                    detail="these are not the files that the other workers serve",
                )
            )
        entries[key] = artifact
    if failures:
        raise RefreshRefusedError(failures)
    restored = prepare(
        ModelSet(
            MappingProxyType(dict(sorted(entries.items()))),
            MappingProxyType(dict(generation.aliases)),
            generation.failure,
        ),
        new_queue,
        previous,
    )
    if Generation.of(restored) != generation:
        # Every file is the same, so what differs is which models answered.
        raise RefreshRefusedError(
            list(restored.warm_up_failures.values()) or list(generation.unanswered.values())
        )
    return restored


def _reference(key: Key) -> str:
    return f"{key[0]}@{key[1]}"


def _key(reference: str) -> Key:
    name, _, version = reference.partition("@")
    return name, version
