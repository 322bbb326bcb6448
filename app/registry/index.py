"""The signed index of a remote store: its versions, its aliases, and its revoked versions.

The index is one object, `index.json`. It lists the digest of each version's manifest, and a
manifest lists the digests of its files. So one signature protects the whole store. The counter
increases with every change, so that a replica notices an older index.

The object is a DSSE envelope (https://github.com/secure-systems-lab/dsse) with Ed25519 signatures
(RFC 8032).
"""

from __future__ import annotations

import base64
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeAlias

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
    load_pem_private_key,
)
from pydantic import AfterValidator, Field, ValidationError

from app.registry.durable import write_file
from app.registry.errors import StoreError, cause
from app.registry.fields import Frozen, Sha256
from app.registry.references import AliasTarget, ModelName, check_name, check_version

MAX_INDEX_BYTES: Final = 4 * 2**20
"""Maximum size of the index in bytes. An entry of a version has about 150 bytes."""

_PAYLOAD_TYPE: Final = "application/vnd.scene-boltzmann.index+json"


def _require_reference(text: str) -> str:
    name, _, version = text.partition("@")
    try:
        check_name(name)
        check_version(version)
    except StoreError as error:
        raise ValueError(error.reason) from None
    return text


Reference: TypeAlias = Annotated[str, AfterValidator(_require_reference)]


class Index(Frozen):
    """The state of a remote store.

    Attributes:
        counter: number of changes of the store since its creation.
        versions: maps ``name@version`` to the SHA-256 of the version's manifest.
        aliases: maps each alias to its target.
        revoked: maps ``name@version`` to the reason why replicas must not serve the version.
    """

    format: Literal[1] = 1
    counter: Annotated[int, Field(ge=0, le=2**53)] = 0
    versions: dict[Reference, Sha256] = Field(default_factory=dict, max_length=10_000)
    aliases: dict[ModelName, AliasTarget] = Field(default_factory=dict, max_length=10_000)
    revoked: dict[Reference, Annotated[str, Field(max_length=500)]] = Field(
        default_factory=dict, max_length=10_000
    )

    def changed(self, **members: Any) -> Index:
        """Return a copy with other members and the next counter."""
        return Index(**(dict(self) | members | {"counter": self.counter + 1}))


class _Signature(Frozen):
    keyid: Annotated[str, Field(max_length=100)]
    sig: Annotated[str, Field(max_length=100)]


class _Envelope(Frozen):
    payload: str
    payloadType: str  # noqa: N815  # the name in the DSSE specification
    signatures: Annotated[list[_Signature], Field(max_length=16)]


@dataclass(frozen=True, slots=True)
class Signer:
    """A private key that signs indexes.

    Attributes:
        key: the private key.
    """

    key: Ed25519PrivateKey

    @classmethod
    def create(cls, path: Path) -> Signer:
        """Create a key and write it to a new PEM file (PKCS #8) that only its owner can read.

        Raises:
            StoreError: `not_writable`.
        """
        signer = cls(Ed25519PrivateKey.generate())
        text = signer.key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
        try:
            write_file(path, text, mode=0o600)
        except OSError as error:
            raise StoreError("not_writable", f"the signing key: {cause(error)}") from None
        return signer

    @classmethod
    def read(cls, path: Path) -> Signer:
        """Read a key from a PEM file.

        Raises:
            StoreError: `invalid_key`.
        """
        try:
            key = load_pem_private_key(path.read_bytes(), None)
        except OSError as error:
            raise StoreError("invalid_key", f"the signing key: {cause(error)}") from None
        except (ValueError, TypeError):
            key = None
        if not isinstance(key, Ed25519PrivateKey):
            raise StoreError("invalid_key", "the signing key must be an Ed25519 key in PEM format")
        return cls(key)

    @property
    def public(self) -> str:
        """The public key in base64, as `SCENE_TRUSTED_KEYS` lists it."""
        raw = self.key.public_key().public_bytes(Encoding.Raw, PublicFormat.Raw)
        return base64.b64encode(raw).decode()


def public_key(text: str) -> Ed25519PublicKey:
    """Return the public key of its base64 text.

    Raises:
        StoreError: `invalid_key` if the text is not the base64 of 32 bytes.
    """
    try:
        return Ed25519PublicKey.from_public_bytes(base64.b64decode(text, validate=True))
    except ValueError:  # also the error of base64
        raise StoreError("invalid_key", "a public key must be the base64 of 32 bytes") from None


def write_index(index: Index, signer: Signer | None) -> bytes:
    """Return the envelope of an index, without a signature if `signer` is None."""
    payload = index.model_dump_json().encode()
    signatures = []
    if signer is not None:
        signature = base64.b64encode(signer.key.sign(_signed_bytes(payload))).decode()
        signatures = [_Signature(keyid=signer.public, sig=signature)]
    envelope = _Envelope(
        payload=base64.b64encode(payload).decode(),
        payloadType=_PAYLOAD_TYPE,
        signatures=signatures,
    )
    return envelope.model_dump_json().encode()


def read_index(data: bytes, trusted: Collection[str] | None) -> Index:
    """Verify the signature of an envelope, and return its index.

    Args:
        data: bytes of the envelope.
        trusted: public keys in base64. One of them must have signed the index. None accepts an
            index without a signature.

    Raises:
        StoreError: `untrusted_index` or `invalid_index`.
    """
    try:
        envelope = _Envelope.model_validate_json(data)
        payload = base64.b64decode(envelope.payload, validate=True)
    except (ValidationError, ValueError):
        raise StoreError("invalid_index", "the index is not a DSSE envelope") from None
    if envelope.payloadType != _PAYLOAD_TYPE:
        raise StoreError("invalid_index", "the envelope does not contain the index of a store")
    if trusted is not None:
        _require_signature(envelope, payload, trusted)
    try:
        return Index.model_validate_json(payload)
    except ValidationError as error:
        detail = error.errors(include_url=False, include_input=False, include_context=False)[0]
        place = ".".join(map(str, detail["loc"]))
        raise StoreError("invalid_index", f"the index: {place}: {detail['msg']}") from None


def _require_signature(envelope: _Envelope, payload: bytes, trusted: Collection[str]) -> None:
    if not envelope.signatures:
        raise StoreError("untrusted_index", "the index is not signed")
    for signature in envelope.signatures:
        if signature.keyid not in trusted:
            continue
        try:
            public_key(signature.keyid).verify(
                base64.b64decode(signature.sig, validate=True), _signed_bytes(payload)
            )
        except (InvalidSignature, ValueError):
            raise StoreError("untrusted_index", "the signature of the index is wrong") from None
        return
    raise StoreError("untrusted_index", "the key that signed the index is not a trusted key")


def _signed_bytes(payload: bytes) -> bytes:
    """Return the pre-authentication encoding (PAE) of DSSE, which the signature covers."""
    kind = _PAYLOAD_TYPE.encode()
    return b"DSSEv1 %d %b %d %b" % (len(kind), kind, len(payload), payload)


def versions_of(references: Iterable[str], name: str) -> list[str]:
    """Return the versions of one model among references ``name@version``."""
    pairs = (reference.split("@") for reference in references)
    return [version for model, version in pairs if model == name]
