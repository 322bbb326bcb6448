"""``python -m app.registry``: move aliases of a store, publish to a remote store, revoke versions.

Without --store, the store is SCENE_STORE, or else the folder model_store, as for the service.
SCENE_SIGNING_KEY is the PEM file of the signing key, and SCENE_TRUSTED_KEYS lists public keys. A
publisher trusts its own key.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
from pathlib import Path
from typing import Final

from app.registry import AliasTarget, RegistryError, Store, StoreError, load_model_set
from app.registry.index import Signer
from app.registry.location import open_for_publisher
from app.registry.remote import RemoteStore

_STORE: Final = "model_store"  # as `Settings.store`


def main(arguments: list[str] | None = None) -> int:
    """Run one command. Return the exit status: 0, or 1 after an error."""
    asked = _parser().parse_args(arguments)
    # The messages of this command contain the errors.
    logging.getLogger("app.registry").addHandler(logging.NullHandler())
    place = ""
    try:
        if asked.command == "key":
            _say(f"public key for SCENE_TRUSTED_KEYS: {Signer.create(Path(asked.file)).public}")
            return 0
        location = asked.store or os.environ.get("SCENE_STORE") or _STORE
        place = f"store {location}: "
        if asked.command == "upload":
            place = f"upload from {asked.source} to {location}: "
            _require_folder(asked.source)
        _require_folder(location)
        _run(asked, open_for_publisher(location))
    except RegistryError as error:
        sys.stderr.write(f"{place}{error.reason}\n")
        return 1
    return 0


def _require_folder(location: str) -> None:
    """Refuse a folder that does not exist, because `Store` would create it."""
    if "://" not in location and not Path(location).is_dir():
        raise StoreError("unreadable", f"there is no folder {location}")


def _run(asked: argparse.Namespace, store: Store) -> None:
    if asked.command == "upload":
        remote, local = _remote(store), Store(asked.source)
        for reference in asked.references:
            artifact = local.load(*local.resolve(reference))
            remote.upload(artifact, asked.alias)
            _say(f"{artifact.manifest.name}@{artifact.manifest.version} is published")
    elif asked.command == "alias":
        store.set_alias(asked.alias, _target(asked.target))
        _say(f"alias '{asked.alias}' points at {asked.target}")
    elif asked.command == "remove-alias":
        store.remove_alias(asked.alias)
        _say(f"alias '{asked.alias}' is removed")
    elif asked.command == "revoke":
        target = _target(asked.reference)
        if target.version is None:
            raise StoreError("invalid_reference", "give the version to revoke as name@version")
        _remote(store).revoke(target.name, target.version, asked.reason)
        _say(f"{asked.reference} is revoked")
    else:
        _list(store)


def _list(store: Store) -> None:
    models = load_model_set(store)
    for name, version in models.entries:
        failure = models.failures.get((name, version))
        state = "" if failure is None else f"  refused: {failure.code}: {failure.reason}"
        _say(f"{name}@{version}{state}")
    for alias, target in models.aliases.items():
        _say(f"{alias} -> {target}")


def _remote(store: Store) -> RemoteStore:
    if not isinstance(store, RemoteStore):
        raise StoreError("invalid_reference", "--store must be a URL: s3://, gs:// or az://")
    return store


def _target(reference: str) -> AliasTarget:
    name, at, version = reference.partition("@")
    try:
        return AliasTarget(name=name, version=version if at else None)
    except ValueError:
        raise StoreError("invalid_reference", f"'{reference}' is not name@version") from None


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m app.registry", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    key = commands.add_parser("key", help="create a signing key and print its public key")
    key.add_argument("file", help="new PEM file")
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument(
        "--store", help=f"folder or URL of the store; default: SCENE_STORE, or else {_STORE}"
    )

    def add(name: str, text: str) -> argparse.ArgumentParser:
        return commands.add_parser(name, help=text, parents=[common])

    upload = add("upload", "copy versions from a folder store to the remote store")
    upload.add_argument("references", nargs="+", help="alias, name or name@version")
    upload.add_argument(
        "--from", dest="source", default=_STORE, help=f"the folder store; default: {_STORE}"
    )
    upload.add_argument("--alias", help="afterwards, point this alias at the version")
    alias = add("alias", "point an alias at a version, for example to roll back")
    alias.add_argument("alias")
    alias.add_argument("target", help="name@version, or name for the newest version")
    add("remove-alias", "remove an alias").add_argument("alias")
    revoke = add("revoke", "forbid replicas to serve a version")
    revoke.add_argument("reference", help="name@version")
    revoke.add_argument("reason", help="reason in words; GET /models shows it")
    add("list", "list versions and aliases, and verify every file")
    return parser


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")


if __name__ == "__main__":
    sys.exit(main())
