"""The store: publishing, aliases, references, and other files in its folder."""

import os
from pathlib import Path

import numpy as np
import pytest

from app.registry import AliasTarget, ArtifactError, Store, StoreError
from app.registry.__main__ import main
from app.registry.durable import exclusive
from app.registry.references import MAX_ALIASES_BYTES, aliases_to_bytes
from app.settings import Settings
from tests.registry.small_artifacts import copy, description, publish_as, refused, state

NO_NAMES = ("", "../up", "a/b", ".hidden", "tiny@1.0.0", "Default")


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store")


def publish(store: Store, version: str = "1.0.0", *, name: str = "tiny", seed: int = 0) -> None:
    store.publish(description(name, version), state(seed=seed))


def published(store: Store) -> dict[str, tuple[str, ...]]:
    return {name: versions for name in store.names() if (versions := store.versions(name))}


def tree(root: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(root)): path.read_bytes()
        for path in sorted(root.rglob("*"))
        if path.is_file() and path.name != ".lock"
    }


def test_publishes_what_a_reader_loads(store: Store) -> None:
    new = publish_as(store, "default", description(), state(), storage_dtype="float16")
    loaded = store.load(*store.resolve("default"))
    assert new.path == loaded.path == store.root / "tiny" / "1.0.0"
    assert new.digest == loaded.digest
    weights = new.model.weights
    assert all(np.array_equal(w, weights[k]) for k, w in loaded.model.weights.arrays.items())
    assert sorted(tree(store.root)) == [
        "aliases.json",
        "tiny/1.0.0/card.md",
        "tiny/1.0.0/manifest.json",
        "tiny/1.0.0/model.safetensors",
    ]


def test_never_overwrites_a_version(store: Store) -> None:
    publish(store)
    before = tree(store.root)
    (store.root / "tiny" / "2.0.0").mkdir()
    for version in ("1.0.0", "2.0.0"):
        with refused("version_exists"):
            publish(store, version, seed=1)
    assert tree(store.root) == before


def test_publishes_nothing_that_would_be_refused(store: Store) -> None:
    weights = state()
    weights["triples"][1] = (3, 99, 0)
    publish(store)
    before = tree(store.root)
    for broken in (weights, {**state(), "W": np.zeros((3, 4), np.float32)}):
        with pytest.raises(ArtifactError):
            store.publish(description(version="2.0.0"), broken)
    assert tree(store.root) == before
    assert [path.name for path in (store.root / "tiny").iterdir()] == ["1.0.0"]


def test_can_be_read_by_another_user(store: Store) -> None:
    before = os.umask(0o022)
    try:
        publish_as(store, "default", description(), state())
    finally:
        os.umask(before)
    for path in store.root.rglob("*"):
        needed = 0o555 if path.is_dir() else 0o444
        assert path.stat().st_mode & needed == needed, path


def test_an_unwritable_store_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for root in (tmp_path / "file", tmp_path / "file" / "store"):
        with pytest.raises(StoreError) as error:
            publish(Store(root))
        assert error.value.code == "not_writable"
        assert str(tmp_path) not in str(error.value)


def test_waits_for_another_writer_but_not_for_ever(tmp_path: Path) -> None:
    """The publishers of `test_crash` wait for each other."""
    store = Store(tmp_path, lock_timeout=0.05)
    with exclusive(tmp_path / ".lock", timeout=0):
        with refused("locked"):
            publish(store)
        assert published(store) == {}, "readers do not wait"


def test_everything_is_on_disk_before_it_is_pointed_at(store, monkeypatch):
    """A rename may outlive a power cut that the renamed bytes do not, unless these came first."""
    events: list[tuple[str, object]] = []
    fsync, rename = os.fsync, Path.rename

    def watched_fsync(descriptor: int) -> None:
        fsync(descriptor)
        events.append(("synced", os.fstat(descriptor).st_ino))

    def watched_rename(source: Path, target: Path) -> Path:
        inodes = {path.stat().st_ino for path in (source, *source.rglob("*"))}
        unsynced = inodes - {inode for kind, inode in events if kind == "synced"}
        assert not unsynced, "renamed before its bytes were on disk"
        events.append(("renamed", target.name))
        return rename(source, target)

    monkeypatch.setattr(os, "fsync", watched_fsync)
    monkeypatch.setattr(Path, "rename", watched_rename)
    publish_as(store, "default", description(), state())
    root, folder = (path.stat().st_ino for path in (store.root, store.root / "tiny"))
    parent = store.root.parent.stat().st_ino
    version = events.index(("renamed", "1.0.0"))
    table = events.index(("renamed", "aliases.json"))
    assert events.index(("synced", parent)) < events.index(("synced", root)) < version
    assert events[version + 1] == ("synced", folder), "the version's entry"
    assert version + 1 < table
    assert events[table + 1] == ("synced", root), "the alias's entry"
    assert [kind for kind, _ in events].count("renamed") == 2


def test_an_alias_moves_only_from_where_it_was_expected(store: Store) -> None:
    publish(store)
    publish(store, "2.0.0")
    one, two = (AliasTarget(name="tiny", version=v) for v in ("1.0.0", "2.0.0"))
    with refused("alias_conflict"):
        store.set_alias("default", two, expected=one)
    store.set_alias("default", one, expected=None)
    for stale in (None, two, AliasTarget(name="tiny")):
        with refused("alias_conflict"):
            store.set_alias("default", two, expected=stale)
    assert store.aliases()["default"] == one
    store.set_alias("default", two, expected=one)
    store.remove_alias("default")
    assert not store.aliases()
    for use in (store.resolve, store.remove_alias):
        with refused("unknown_model"):
            use("default")


def test_an_alias_needs_a_target_and_a_name_of_its_own(store: Store) -> None:
    publish(store)
    store.set_alias("taken", AliasTarget(name="tiny"))
    for code, alias, target in (
        ("unknown_model", "default", "nothing"),
        ("unknown_version", "default", "tiny@9.0.0"),
        ("name_conflict", "tiny", "tiny"),
        *(("invalid_reference", alias, "tiny") for alias in NO_NAMES),
    ):
        with refused(code):
            store.set_alias(alias, AliasTarget.of(target))
    with refused("name_conflict"):
        store.publish(description("taken", "2.0.0"), state())
    assert published(store) == {"tiny": ("1.0.0",)}


def test_the_writer_of_aliases_applies_the_limits_of_the_reader(store: Store) -> None:
    publish(store)
    target = AliasTarget(name="tiny")
    names = [f"a{number:063}" for number in range(3000)]
    one, two = (len(aliases_to_bytes(dict.fromkeys(names[:n], target))) for n in (1, 2))
    number = 1 + (MAX_ALIASES_BYTES - one) // (two - one)
    with refused("not_writable"):
        aliases_to_bytes(dict.fromkeys(names[: number + 1], target))
    table = dict.fromkeys(names[:number], target)
    text = aliases_to_bytes(table)
    (store.root / "aliases.json").write_bytes(text)
    assert store.aliases() == table, "the largest table that can be written can be read"
    with refused("not_writable"):
        store.set_alias("b" * 64, target)
    assert (store.root / "aliases.json").read_bytes() == text
    store.remove_alias(table.popitem()[0])
    store.set_alias("b" * 64, target)
    assert store.aliases() == table | {"b" * 64: target}


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{",
        '{"default": "tiny"}',
        '{"default": {"name": "tiny", "surplus": 1}}',
        '{"default": {"name": "../tiny"}}',
        '{"../default": {"name": "tiny"}}',
        '{"default": {"name": "tiny", "version": "latest"}}',
        '{"default": {"version": "1.0.0"}}',
        '{"_shipped": "tiny"}',
        '{"_shipped": {"surplus": 1}}',
        '{"_shipped": {"replaced": {"old": "tiny"}}}',
        '{"_shipped": {"replaced": {"old": {"by": "tiny", "digests": {"1.0.0": "ab"}}}}}',
    ],
)
def test_an_invalid_alias_table_is_refused_and_kept(text: str, store: Store) -> None:
    publish(store)
    (store.root / "aliases.json").write_text(text)
    for use in (
        store.aliases,
        lambda: store.resolve("default"),
        lambda: store.set_alias("default", AliasTarget(name="tiny")),
        lambda: store.remove_alias("default"),
        lambda: store.publish(description(version="2.0.0"), state()),
    ):
        with refused("invalid_aliases"):
            use()
    assert (store.root / "aliases.json").read_text() == text
    assert store.versions("tiny") == ("1.0.0",)


def test_readers_see_no_leftovers_and_the_next_writer_clears_them(store: Store) -> None:
    """Those of publishers that die in `test_crash`, and a folder without another version."""
    publish(store)
    only = store.root / "other" / ".publishing-1.0.0-dead"
    only.mkdir(parents=True)
    # Other files are left alone.
    (store.root / "README.md").write_text("about")
    (store.root / "plain").write_text("a file")
    (store.root / "lost+found").mkdir()
    (store.root / "tiny" / "notes").mkdir()
    assert published(store) == {"tiny": ("1.0.0",)}
    publish(store, "2.0.0")
    assert not only.exists()
    assert published(store) == {"tiny": ("1.0.0", "2.0.0")}
    assert (store.root / "README.md").read_text() == "about"


def test_clearing_does_not_follow_links(store: Store, tmp_path: Path) -> None:
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / ".publishing-1.0.0-x").write_text("")
    publish(store)
    (store.root / "tiny" / ".publishing-link").symlink_to(tmp_path / "precious")
    (store.root / "linked").symlink_to(tmp_path / "precious")
    publish(store, "2.0.0")
    assert (tmp_path / "precious" / ".publishing-1.0.0-x").exists()
    assert not os.path.lexists(store.root / "tiny" / ".publishing-link")


def test_a_model_outside_the_root_is_no_model(store: Store, tmp_path: Path) -> None:
    publish(store)
    outside = Store(tmp_path / "outside")
    publish(outside, name="foreign")
    (store.root / "foreign").symlink_to(outside.root / "foreign")
    assert published(store) == {"tiny": ("1.0.0",)}
    with refused("unknown_model"):
        store.resolve("foreign")
    with refused("unsafe_path"):
        publish(store, "2.0.0", name="foreign")
    assert outside.versions("foreign") == ("1.0.0",)


@pytest.mark.parametrize("name", ["", "..", "../tiny", "/etc", "tiny\0"])
def test_no_name_leads_out_of_the_root(name: str, store: Store) -> None:
    publish(store)
    for use in (store.versions, lambda name: store.load(name, "1.0.0")):
        with refused("invalid_reference"):
            use(name)
    with refused("invalid_reference"):
        store.load("tiny", "1.0.0/..")


def test_a_missing_store_is_an_error_and_an_empty_one_is_not(store: Store) -> None:
    with refused("unreadable"):
        published(store)
    store.root.mkdir()
    assert published(store) == store.aliases() == {}


def test_the_command_changes_the_store_of_the_service_and_creates_none(
    store, tmp_path, monkeypatch, capsys
):
    publish(store)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SCENE_STORE", raising=False)
    alias = ["alias", "default", "tiny@1.0.0"]
    assert main([*alias, "--store", "stor"]) == 1
    assert "there is no folder stor" in capsys.readouterr().err
    assert main(alias) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["store"]
    store.root.rename(Settings.model_fields["store"].default)
    assert main(["alias", "default", "tiny@2.0.0"]) == 1
    assert "store model_store: model 'tiny' does not have" in capsys.readouterr().err
    assert main(alias) == 0
    assert capsys.readouterr().out == "alias 'default' points at tiny@1.0.0\n"
    publish(store := Store("model_store"), "2.0.0")
    assert main(["alias", "default", "tiny"]) == 0
    assert main([*alias, "--expected", "tiny"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[1] == "alias 'default' points at tiny@1.0.0, before at tiny"
    assert main(["alias", "default", "tiny", "--expected", "tiny@2.0.0"]) == 1
    conflict = "alias 'default' points at tiny@1.0.0, not at tiny@2.0.0"
    assert conflict in capsys.readouterr().err
    (store.root / "tiny" / "2.0.0" / "card.md").unlink()
    assert main(["alias", "default", "tiny@2.0.0"]) == 1
    assert "tiny@2.0.0: the artifact has no file card.md" in capsys.readouterr().err
    assert main(["list"]) == 0
    listed = capsys.readouterr().out.splitlines()
    assert listed[0] == "tiny@1.0.0"
    assert listed[1].startswith("tiny@2.0.0  refused: missing_file")
    assert listed[2:] == ["default -> tiny@1.0.0"]
    assert main(["remove-alias", "default"]) == 0
    assert not store.aliases()
    (store.root / "aliases.json").write_text("{")
    assert main(["list"]) == 1
    printed = capsys.readouterr()
    assert printed.out.splitlines()[-2:] == listed[:2]
    assert "store model_store: " in printed.err


@pytest.fixture
def shipped(tmp_path: Path) -> Store:
    store = Store(tmp_path / "shipped")
    publish(store, "1.0.0")
    publish_as(store, "default", description(version="2.0.0"), state(seed=1))
    publish_as(store, "spare", description("other"), state(seed=2))
    return store


def test_copies_of_a_store_are_equal_and_repeatable(shipped, store, capsys):
    store.root.mkdir()
    assert copy(shipped, store) == 0
    assert tree(store.root) == tree(shipped.root)
    assert "alias 'default' points at tiny@2.0.0\n" in capsys.readouterr().out
    state = store.state()
    assert copy(shipped, store) == 0
    assert store.state() == state, "the second copy touches no file"
    assert "tiny@2.0.0 is already there" in capsys.readouterr().out


@pytest.mark.parametrize(("reference", "version"), [("tiny@1.0.0", "1.0.0"), ("default", "2.0.0")])
def test_copies_one_version_and_no_alias(shipped, store, reference, version):
    store.root.mkdir()
    assert copy(shipped, store, reference) == 0
    assert published(store) == {"tiny": (version,)}
    assert not store.aliases()
    assert store.load("tiny", version).digest == shipped.load("tiny", version).digest


def test_an_upgrade_moves_an_alias_forward_once_and_keeps_own_choices(shipped, store, capsys):
    publish_as(store, "default", description(version="1.5.0"), state(seed=3))
    publish_as(store, "spare", description("own"), state(seed=4))
    assert copy(shipped, store) == 0
    aliases = {alias: str(target) for alias, target in store.aliases().items()}
    assert aliases == {"default": "tiny@2.0.0", "spare": "own@1.0.0"}
    printed = capsys.readouterr().out
    assert "alias 'default' points at tiny@2.0.0, before at tiny@1.5.0" in printed
    assert "alias 'spare' still points at own@1.0.0, not at other@1.0.0" in printed
    rolled_back = AliasTarget(name="tiny", version="1.5.0")
    store.set_alias("default", rolled_back)
    assert copy(shipped, store) == 0
    assert store.aliases()["default"] == rolled_back
    assert published(store)["tiny"] == ("1.0.0", "1.5.0", "2.0.0")


def test_a_copy_replaces_no_other_version_of_the_same_number(shipped, store, capsys):
    publish(store, "2.0.0", seed=5)
    before = store.load("tiny", "2.0.0").digest
    assert copy(shipped, store) == 1
    printed = capsys.readouterr()
    assert "tiny@2.0.0 is not copied: tiny@2.0.0 is already published" in printed.err
    assert "tiny@1.0.0 is copied" in printed.out
    assert store.load("tiny", "2.0.0").digest == before
    assert published(store) == {"other": ("1.0.0",), "tiny": ("1.0.0", "2.0.0")}


def test_damaged_versions_are_not_copied_nor_taken_for_copies(shipped, store, capsys):
    store.root.mkdir()
    assert copy(shipped, store) == 0
    for root, version in ((shipped.root, "1.0.0"), (store.root, "2.0.0")):
        weights = root / "tiny" / version / "model.safetensors"
        weights.write_bytes(weights.read_bytes()[:-1])
    (shipped.root / "tiny" / "3.0.0").mkdir()  # without a manifest: not yet uploaded
    before = tree(store.root)
    capsys.readouterr()
    assert copy(shipped, store) == 1
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith("tiny@1.0.0 is not copied: model.safetensors has only")
    assert "the copy of tiny@2.0.0 is damaged" in second
    assert "Remove its folder tiny/2.0.0, then copy again" in second
    assert tree(store.root) == before
    assert not [path for path in (store.root / "tiny").iterdir() if path.name.startswith(".")]


def test_a_copy_names_the_store_that_is_missing(shipped, store, capsys):
    assert copy(shipped, store) == 1
    assert f"store {store.root}: there is no folder" in capsys.readouterr().err
    assert copy(store, shipped) == 1
    assert f"store {store.root}: there is no folder" in capsys.readouterr().err
    store.root.mkdir()
    assert copy(shipped, store, "tiny@9.0.0") == 1
    assert f"store {shipped.root}: model 'tiny' does not have version" in capsys.readouterr().err
