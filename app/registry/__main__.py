"""``python -m app.registry``: move aliases of a store, and list its versions.

Without --store, the store is SCENE_STORE, or else the folder model_store, as for the service.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
from pathlib import Path
from typing import Final

from app.registry import AliasTarget, RegistryError, Store, StoreError, load_model_set

_STORE: Final = "model_store"  # as `Settings.store`


def main(arguments: list[str] | None = None) -> int:
    """Run one command. Return the exit status: 0, or 1 after an error."""
    options = _parser().parse_args(arguments)
    # The messages of this command contain the errors.
    logging.getLogger("app.registry").addHandler(logging.NullHandler())
    root = options.store or os.environ.get("SCENE_STORE") or _STORE
    try:
        if not Path(root).is_dir():  # `Store` would create it
            raise StoreError("unreadable", f"there is no folder {root}")
        _run(options, Store(root))
    except RegistryError as error:
        sys.stderr.write(f"store {root}: {error.reason}\n")
        return 1
    return 0


def _run(options: argparse.Namespace, store: Store) -> None:
    if options.command == "alias":
        store.set_alias(options.alias, _target(options.target))
        _print(f"alias '{options.alias}' points at {options.target}")
    elif options.command == "remove-alias":
        store.remove_alias(options.alias)
        _print(f"alias '{options.alias}' is removed")
    else:
        _list(store)


def _list(store: Store) -> None:
    models = load_model_set(store)
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
    common.add_argument("--store", help=f"folder; default: SCENE_STORE, or else {_STORE}")

    def add(name: str, text: str) -> argparse.ArgumentParser:
        return commands.add_parser(name, help=text, parents=[common])

    alias = add("alias", "point an alias at a version, for example to roll back")
    alias.add_argument("alias")
    alias.add_argument("target", help="name@version, or name for the newest usable version")
    add("remove-alias", "remove an alias").add_argument("alias")
    add("list", "list versions and aliases, and verify every file")
    return parser


def _print(line: str) -> None:
    sys.stdout.write(f"{line}\n")


if __name__ == "__main__":
    sys.exit(main())
