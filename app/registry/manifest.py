"""The manifest of an artifact: the description of the model and the checksums of its files.

A manifest is a JSON object with one top-level member per line. The last member is the SHA-256 of
all bytes before it. It reveals a truncated or altered manifest before the manifest is parsed. It
also protects the other files, whose checksums the manifest contains.
"""

import hashlib
import json
import re
from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field, ValidationError, field_validator

from app.model import Counts, Offsets, Places, Possibility
from app.model.fields import Count, Frozen, Many, Sha256, TensorGroup, first_error, to_json
from app.registry.description import Description
from app.registry.errors import ArtifactError, Code

FORMAT: Final = 12
MAX_TENSORS: Final = 10_000
WEIGHTS: Final = "model.safetensors"
CARD: Final = "card.md"
MANIFEST: Final = "manifest.json"

GROUPS: Final[tuple[type[TensorGroup], ...]] = (Offsets, Counts, Places, Possibility)
"""The tables of a model beside the machine."""

_TRAILER: Final = re.compile(rb',\n"checksum": "([0-9a-f]{64})"\n}\n\Z')


class TensorEntry(Frozen):
    """Dtype and shape of a stored tensor."""

    dtype: Literal["float16", "float32", "int32", "int64", "bool"]
    shape: Many[Count]


def of_machine(tensors: Mapping[str, TensorEntry]) -> dict[str, TensorEntry]:
    """Return the tensors of the machine, without those of `GROUPS`."""
    statistics = tuple(group.prefix for group in GROUPS)
    return {name: entry for name, entry in tensors.items() if not name.startswith(statistics)}


class FileEntry(Frozen):
    """Checksum and size of a file."""

    sha256: Sha256
    bytes: Count


class Manifest(Description):
    """The description of a model, its stored tensors and the checksums of its other files."""

    format: Literal[12] = FORMAT
    tensors: Annotated[dict[str, TensorEntry], Field(max_length=MAX_TENSORS)]
    files: dict[str, FileEntry]

    @field_validator("files")
    @classmethod
    def _check_files(cls, files: dict[str, FileEntry]) -> dict[str, FileEntry]:
        if set(files) != {WEIGHTS, CARD}:
            raise ValueError(f"the files must be exactly {WEIGHTS} and {CARD}")
        return files

    def to_bytes(self) -> bytes:
        """Return the contents of the manifest file, with the checksum at the end."""
        members = self.model_dump(mode="json")
        members = {"format": members.pop("format"), **members}
        lines = ",\n".join(f"{to_json(name)}: {to_json(value)}" for name, value in members.items())
        body = f"{{\n{lines}".encode()
        return body + f',\n"checksum": "{hashlib.sha256(body).hexdigest()}"\n}}\n'.encode()

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Parse the contents of a manifest file.

        Raises:
            ArtifactError: with code `truncated`, `checksum_mismatch`, `outdated_format`,
                `unknown_format` or `invalid_manifest`.
        """
        trailer = _TRAILER.search(data)
        if trailer and hashlib.sha256(data[: trailer.start()]).hexdigest().encode() != trailer[1]:
            raise _refused("checksum_mismatch", "does not match its own checksum: it was altered")
        try:
            members = json.loads(data)
        except (ValueError, RecursionError):
            if trailer:
                raise _refused("invalid_manifest", "is not JSON") from None
            raise _refused("truncated", "is truncated or not JSON") from None
        if not isinstance(members, dict):
            raise _refused("invalid_manifest", "is not a JSON object")
        if type(version := members.get("format")) is int and 0 < version < FORMAT:
            again = _advice(members)
            reason = f"has format {version}, but this release reads format {FORMAT}: {again}"
            raise _refused("outdated_format", reason)
        if type(version) is not int or version != FORMAT:
            advice = "the only format of this release; train or publish the model again"
            raise _refused("unknown_format", f"does not have format {FORMAT}, {advice}")
        if not trailer:
            raise _refused("invalid_manifest", "does not end with its checksum in the last line")
        del members["checksum"]
        try:
            return cls.model_validate(members)
        except ValidationError as error:
            reason = f"has an invalid field: {first_error(error)}"
            raise _refused("invalid_manifest", reason) from None


def _advice(members: Mapping[str, Any]) -> str:
    """Return how to make a model of an older format again."""
    training = members.get("training")
    if isinstance(training, dict) and "parent" in training:
        return "adapt the model to its home again (python -m training adapt)"
    return "train the model again (python -m training train)"


def _refused(code: Code, reason: str) -> ArtifactError:
    return ArtifactError(code, f"{MANIFEST} {reason}")
