"""Errors of the registry. Each error has a machine-readable code and a reason for people."""

import errno
from typing import Final, Literal

from scene_client.untrusted import printable

Code = Literal[
    # of an artifact
    "missing_file", "unexpected_file", "unreadable", "too_large", "truncated", "checksum_mismatch",
    "outdated_format", "unknown_format", "invalid_manifest", "not_safetensors", "wrong_shape",
    "not_finite", "invalid_tensor", "unsupported", "wrong_place", "unexpected_error",
    "warm_up_failed",
    # of an artifact or of a reference
    "replaced_model",
    # of a store; its folders may be "unreadable" too
    "invalid_reference", "unknown_model", "unknown_version", "dangling_alias", "invalid_aliases",
    "version_exists", "name_conflict", "alias_conflict", "unsafe_path", "not_writable", "locked",
]  # fmt: skip


OUTDATED: Final[frozenset[Code]] = frozenset({"outdated_format", "replaced_model"})
"""Codes of models that an earlier release could load."""


class RegistryError(Exception):
    """Base class of the registry's errors. The reason is one line, without absolute paths."""

    def __init__(self, code: Code, reason: str) -> None:
        reason = printable(reason)  # it may name a tensor or a field of a hostile file
        super().__init__(code, reason)
        self.code: Code = code
        self.reason = reason  # may name a file or a tensor, but not the folder

    def __str__(self) -> str:
        return f"{self.code}: {self.reason}"


class ArtifactError(RegistryError):
    """An artifact (the files of one model version) is invalid or cannot be read."""


class StoreError(RegistryError):
    """A reference (alias, name or name@version) does not resolve, or the store refused a change."""


def cause(error: OSError) -> str:
    """Return the message of the operating system. Unlike str(error), it contains no path."""
    if error.errno == errno.ELOOP:
        return "the path contains a symbolic link, which the store does not follow"
    return error.strerror or "input/output error"
