"""Models that a release replaces: the statement, the copy of an upgrade, and old names."""

from pathlib import Path

import pytest

from app.registry import AliasTarget, Store, load_model_set
from app.registry.references import Replacement, Shipped, aliases_to_bytes
from tests.registry.small_artifacts import (
    copy,
    description,
    make_outdated,
    publish_as,
    refused,
    state,
    state_replaced,
)

TERMS = "Any use,\nwith the sources named."
REPLACED = {"old": "new", "old-rbm": "new-rbm"}
PARENT = {"name": "old", "version": "3.5.0"}


@pytest.fixture
def volume(tmp_path: Path) -> Store:
    """The store of a service of the last release, with own models."""
    store = Store(tmp_path / "volume")
    publish_as(store, "default", description("old", "3.5.0"), state())
    store.publish(description("old-rbm", "3.5.0"), state(seed=1))
    store.publish(description("home"), state(seed=2))
    return store


@pytest.fixture
def release(tmp_path: Path, volume: Store) -> Store:
    """The shipped store of a release that replaces the models of the volume."""
    store = Store(tmp_path / "release")
    publish_as(store, "default", description("new", "4.0.0", terms=TERMS), state(seed=3))
    store.publish(description("new-rbm", "4.0.0"), state(seed=4))
    state_replaced(store, volume, REPLACED)
    return store


def default(store: Store) -> str:
    return str(store.aliases()["default"])


def test_changes_of_aliases_keep_the_statement_of_the_release(release: Store) -> None:
    stated = release.shipped()
    assert stated.default == AliasTarget.of("new@4.0.0")
    release.set_alias("spare", AliasTarget(name="new-rbm"))
    release.remove_alias("default")
    assert release.shipped() == stated
    assert dict(release.aliases()) == {"spare": AliasTarget(name="new-rbm")}


@pytest.mark.parametrize(
    ("target", "moved"),
    [("old@3.5.0", "new@4.0.0"), ("old", "new@4.0.0"), ("old-rbm@3.5.0", "new-rbm@4.0.0")],
)
def test_an_upgrade_moves_the_default_from_a_replaced_model_and_says_the_terms(
    volume, release, target, moved, capsys
):
    volume.set_alias("default", AliasTarget.of(target))
    volume.set_alias("mine", AliasTarget.of("old@3.5.0"))
    assert copy(release, volume) == 0
    assert default(volume) == moved
    assert str(volume.aliases()["mine"]) == "old@3.5.0"
    printed = capsys.readouterr().out.splitlines()
    assert f"alias 'default' points at {moved}, before at {target}" in printed
    terms = "Any use, with the sources named." if moved == "new@4.0.0" else "Apache-2.0"
    assert printed[-1] == f"{moved} replaces {target}. Its terms of use: {terms}"
    # Today's table can still be read by the last release: the volume has no statement.
    assert volume.shipped() == Shipped()


@pytest.mark.parametrize(
    ("target", "own"),
    [("home@1.0.0", None), ("old@3.6.0", "3.6.0"), ("old@3.5.0", "3.5.0"), ("old", "3.4.0")],
)
def test_an_upgrade_never_moves_the_default_from_an_own_model(volume, release, target, own, capsys):
    """An own version may be newer, have the number of a shipped one, or stand beside one."""
    if own == "3.5.0":
        volume.root.joinpath("old", own).rename(volume.root / "away")
    if own:
        volume.publish(description("old", own), state(seed=5))
    volume.set_alias("default", AliasTarget.of(target))
    assert copy(release, volume) == 0
    assert default(volume) == target
    assert f"alias 'default' still points at {target}, not at new@4.0.0" in capsys.readouterr().out


def test_a_default_that_was_moved_back_stays_while_the_old_model_is_readable(volume, release):
    assert copy(release, volume) == 0
    volume.set_alias("default", AliasTarget.of("old@3.5.0"))
    assert copy(release, volume) == 0
    assert default(volume) == "old@3.5.0"
    make_outdated(volume, "old", "3.5.0")
    state_replaced(release, volume, REPLACED)
    assert copy(release, volume) == 0
    assert default(volume) == "new@4.0.0"


def test_old_names_lead_to_the_new_ones_unless_the_store_has_the_old_model(volume, release):
    for reference in ("old", "old@3.5.0"):
        for resolve in (release.resolve, load_model_set(release).resolve):
            with refused("replaced_model") as raised:
                resolve(reference)
            assert raised.value.reason == "'new' replaces the model 'old'"
        models = load_model_set(volume, release=release)
        assert models.resolve(reference).key == ("old", "3.5.0")
    with refused("unknown_version"):
        release.resolve("new@3.5.0")


@pytest.mark.parametrize(
    ("name", "version", "training", "code", "advice"),
    [
        ("home", "2.0.0", {"parent": PARENT}, "outdated_format", "adapt the model"),
        ("lab", "1.0.0", {"seed": 7}, "outdated_format", "train the model again"),
        ("old", "3.6.0", {}, "outdated_format", "train the model again"),
        ("old", "3.5.0", None, "replaced_model", "'new' replaces this version"),
    ],
)
def test_a_model_of_an_older_format_says_how_to_go_on(
    volume, release, name, version, training, code, advice
):
    if training is not None:
        volume.publish(description(name, version, training=training), state())
    make_outdated(volume, name, version)
    state_replaced(release, volume, {"old": "new"}, versions=["3.5.0"])
    failure = load_model_set(volume, release=release).failures[name, version]
    assert failure.code == code
    assert advice in failure.reason
    assert "\n" not in failure.reason


def test_a_damaged_statement_of_the_release_takes_no_model_down(volume, release):
    (release.root / "aliases.json").write_text("{")
    models = load_model_set(volume, release=release)
    assert models.failure is None
    assert models.resolve("default").key == ("old", "3.5.0")


def test_the_table_of_an_earlier_release_is_valid(tmp_path: Path) -> None:
    table = {"default": AliasTarget.of("old@3.5.0"), "replaced": AliasTarget(name="old")}
    (tmp_path / "aliases.json").write_bytes(aliases_to_bytes(table))
    store = Store(tmp_path)
    assert store.aliases() == table
    assert store.shipped() == Shipped()
    stated = Shipped(replaced={"old": Replacement(by="new")})
    (tmp_path / "aliases.json").write_bytes(aliases_to_bytes(table, stated))
    assert (store.aliases(), store.shipped()) == (table, stated)
