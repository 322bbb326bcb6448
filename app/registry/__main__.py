"""``python -m app.registry``: list versions, move aliases, and copy versions between stores.

Without --store, the store is SCENE_STORE, or else the folder model_store, as for the service.
"""

import argparse
import logging
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TextIO

from app.registry import DEFAULT_STORE, RegistryError, Store, StoreError, load_model_set
from app.registry.references import AliasTarget, version_key
from scene_client.untrusted import printable


def main(arguments: list[str] | None = None) -> int:
    """Run one command. Return the exit status: 0, or 1 after an error."""
    options = _parser().parse_args(arguments)
    # The messages of this command contain the errors.
    logging.getLogger("app.registry").addHandler(logging.NullHandler())
    root = target = options.store or os.environ.get("SCENE_STORE") or DEFAULT_STORE
    try:
        if options.command == "copy":
            source = _existing(root := options.source)
            # Aliases come first: a publisher adds a version before its alias.
            aliases = {} if options.reference else source.aliases()
            keys = _keys(source, options.reference)
            return _copy(source, keys, aliases, _existing(root := target))
        store = _existing(root)
        if options.command == "alias":
            _point(store, options.alias, _target(options.target), options.expected)
        elif options.command == "remove-alias":
            store.remove_alias(options.alias)
            _print(f"alias '{options.alias}' is removed")
        else:
            _list(store)
        return 0
    except RegistryError as error:
        _print(f"store {root}: {error.reason}", sys.stderr)
        return 1


def _existing(root: str) -> Store:
    if not Path(root).is_dir():
        raise StoreError("unreadable", f"there is no folder {root}")
    return Store(root)


def _point(store: Store, alias: str, target: AliasTarget, expected: str | None) -> None:
    """Point an alias at a usable version. With ``expected``, it must have this target before."""
    load_model_set(store, release=Store(DEFAULT_STORE)).resolve(str(target))
    before = store.aliases().get(alias)
    store.set_alias(alias, target, expected=before if expected is None else _target(expected))
    _print(f"alias '{alias}' points at {target}" + (f", before at {before}" if before else ""))


def _keys(store: Store, reference: str | None) -> list[tuple[str, str]]:
    if reference is not None:
        return [store.resolve(reference)]
    return [(name, version) for name in store.names() for version in store.versions(name)]


def _copy(
    source: Store, keys: list[tuple[str, str]], aliases: Mapping[str, AliasTarget], target: Store
) -> int:
    """Copy versions, then aliases. Return 1 if a version is not copied."""
    added, status = set(), 0
    for key in keys:
        try:
            is_new = target.copy(source, *key)
        except RegistryError as error:
            _print(f"{'@'.join(key)} is not copied: {error.reason}", sys.stderr)
            status = 1
            continue
        if is_new:
            added.add(key)
        _print(f"{'@'.join(key)} {'is copied' if is_new else 'is already there'}")
    present = target.aliases()
    for alias, new in aliases.items():
        old = present.get(alias)
        if replacement := old and _replacement(old, new, source, target, added):
            new = replacement
        if old is None or replacement or _is_upgrade(old, new, added):
            target.set_alias(alias, new, expected=old)
            _print(f"alias '{alias}' points at {new}" + (f", before at {old}" if old else ""))
        elif old != new:
            _print(f"alias '{alias}' still points at {old}, not at {new}")
        if replacement:
            terms = target.load(*target.resolve(str(new))).manifest.terms
            _print(f"{new} replaces {old}. Its terms of use: {terms}")
    return status


def _replacement(
    old: AliasTarget, new: AliasTarget, source: Store, target: Store, added: set[tuple[str, str]]
) -> AliasTarget | None:
    """Return the new target of an alias to a replaced shipped model, or None if it stays."""
    versions = target.versions(old.name) if old.version is None else (old.version,)
    shipped = source.shipped()
    names = {shipped.replacement(old.name, v, target.digest(old.name, v)) for v in versions}
    if len(names) != 1 or (name := names.pop()) is None:
        return None
    if new.name != name:
        new = AliasTarget(name=name, version=source.resolve(name)[1])
    is_new = (new.name, new.version) in added
    return new if is_new or not _is_usable(target, old.name, versions[-1]) else None


def _is_usable(store: Store, name: str, version: str) -> bool:
    try:
        store.load(name, version)
    except RegistryError:
        return False
    return True


def _is_upgrade(old: AliasTarget, new: AliasTarget, added: set[tuple[str, str]]) -> bool:
    """Return whether an alias pins an older version of a model that has just been added."""
    if old.version is None or new.version is None or old.name != new.name:
        return False
    return (new.name, new.version) in added and version_key(old.version) < version_key(new.version)


def _list(store: Store) -> None:
    """Print each version with its error, and the aliases. Raise an error of the store itself."""
    models = load_model_set(store, release=Store(DEFAULT_STORE))
    for name, version in models.entries:
        failure = models.failures.get((name, version))
        state = "" if failure is None else f"  refused: {failure.code}: {failure.reason}"
        _print(f"{name}@{version}{state}")
    for alias, target in models.aliases.items():
        _print(f"{alias} -> {target}")
    if models.failure is not None:
        raise models.failure


def _target(reference: str) -> AliasTarget:
    try:
        return AliasTarget.of(reference)
    except ValueError:
        raise StoreError("invalid_reference", f"'{reference}' is not name@version") from None


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m app.registry", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    common = argparse.ArgumentParser(add_help=False)
    default = f"folder; default: SCENE_STORE, or else {DEFAULT_STORE}"
    common.add_argument("--store", help=default)

    def add(name: str, text: str) -> argparse.ArgumentParser:
        return commands.add_parser(name, help=text, parents=[common])

    alias = add("alias", "point an alias at a version, for example to roll back")
    alias.add_argument("alias")
    alias.add_argument("target", help="name@version, or name for the newest usable version")
    alias.add_argument("--expected", metavar="TARGET", help="change only an alias with this target")
    add("remove-alias", "remove an alias").add_argument("alias")
    copy = commands.add_parser(
        "copy",
        help="copy a version, or all versions and aliases, from another store",
        description="Without a model, copy all versions, add missing aliases, and move an alias "
        "from an older version of a model to a copied version, or from a shipped model of an "
        "earlier release to the model that replaces it. Other aliases stay.",
    )
    copy.add_argument("reference", nargs="?", metavar="NAME[@VERSION]", help="default: all")
    copy.add_argument("--from", dest="source", metavar="STORE", required=True, help="folder")
    copy.add_argument("--to", dest="store", metavar="STORE", help=default)
    add("list", "list versions and aliases, and verify every file")
    return parser


def _print(line: str, stream: TextIO | None = None) -> None:
    (stream or sys.stdout).write(f"{printable(line)}\n")


if __name__ == "__main__":
    sys.exit(main())
