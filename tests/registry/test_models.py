"""The loaded snapshot, references to its models, and models that a release replaces."""

import shutil
from collections.abc import Mapping
from pathlib import Path

import pytest

from app.registry import AliasTarget, ArtifactError, Store, load_model_set
from app.registry.references import Replacement, Shipped, aliases_to_bytes, resolve_reference
from tests.registry.small_artifacts import (
    copy,
    description,
    make_outdated,
    publish_as,
    refused,
    state,
    state_replaced,
)


@pytest.fixture
def store(tmp_path: Path) -> Store:
    store = Store(tmp_path / "store")
    store.publish(description(), state())
    store.publish(description(version="2.0.0"), state(seed=1))
    store.publish(description(name="other"), state(seed=2))
    store.set_alias("default", AliasTarget(name="tiny"))
    return store


def test_a_name_means_the_newest_usable_version(store: Store) -> None:
    for version, wanted in (("2.0.0", "1.0.0"), ("1.0.0", None)):
        (store.root / "tiny" / version / "model.safetensors").write_bytes(b"")
        models = load_model_set(store)
        assert models.failures["tiny", version].code == "truncated"
        assert models.resolve("other").manifest.name == "other"
        names = ("tiny", "default")
        if wanted:
            assert {models.resolve(name).manifest.version for name in names} == {wanted}
        for reference in ("tiny@2.0.0", *(() if wanted else names)):
            with pytest.raises(ArtifactError) as raised:
                models.resolve(reference)
            assert raised.value.code == "truncated"
            assert "tiny@2.0.0" in raised.value.reason


def test_other_files_in_place_of_a_version_are_reported(store: Store) -> None:
    (store.root / "tiny" / "3.0.0").mkdir()
    (store.root / "tiny" / "3.0.0" / "manifest.json").mkdir()
    (store.root / "tiny" / "4.0.0").write_text("not a directory")
    (store.root / "tiny" / "5.0.0").symlink_to(store.root / "tiny" / "1.0.0")
    # Copies with another version or another name than their manifest.
    shutil.copytree(store.root / "tiny" / "1.0.0", store.root / "tiny" / "6.0.0")
    shutil.copytree(store.root / "tiny" / "1.0.0", store.root / "copy" / "1.0.0")
    failures = {"@".join(key): f.code for key, f in load_model_set(store).failures.items()}
    assert failures == {
        **{f"tiny@{major}.0.0": "unreadable" for major in (3, 4, 5)},
        **dict.fromkeys(("tiny@6.0.0", "copy@1.0.0"), "wrong_place"),
    }


@pytest.mark.parametrize("file", ["model.safetensors", "card.md"])
def test_loaded_versions_are_verified_again(file: str, store: Store) -> None:
    first = load_model_set(store)
    path = store.root / "tiny" / "2.0.0" / file
    good = path.read_bytes()
    path.write_bytes(good[:-1] + bytes([good[-1] ^ 1]))
    broken = load_model_set(store, first)
    failure = broken.failures["tiny", "2.0.0"]
    assert failure.code == "checksum_mismatch"
    assert failure.reason == f"{file} does not match its checksum: the file was altered"
    assert failure.__traceback__ is failure.__context__ is None
    path.write_bytes(good)
    assert load_model_set(store, broken).resolve("tiny").digest == first.resolve("tiny").digest


def test_spoilt_aliases_leave_names_usable(store: Store) -> None:
    (store.root / "aliases.json").write_text("{")
    models = load_model_set(store)
    assert models.failure.code == "invalid_aliases"
    assert models.resolve("tiny").manifest.version == "2.0.0"
    with refused("invalid_aliases"):
        models.resolve("default")


def test_a_publication_between_two_looks_leaves_no_alias_dangling(store: Store) -> None:
    class OvertakenStore(Store):
        """Another process publishes right after the first look, whichever that is."""

        overtaken = False

        def overtake(self) -> None:
            if not self.overtaken:
                self.overtaken = True
                publish_as(store, "default", description(name="zeta"), state())

        def aliases(self) -> Mapping[str, AliasTarget]:
            found = super().aliases()
            self.overtake()
            return found

        def versions(self, name: str) -> tuple[str, ...]:
            found = super().versions(name)
            self.overtake()
            return found

    models = load_model_set(OvertakenStore(store.root))
    assert models.resolve("default").manifest.name == "tiny"


def test_one_unreadable_folder_does_not_take_the_others_down(store, monkeypatch):
    iterdir = Path.iterdir

    def deny(path: Path) -> object:
        if path.name == "other":
            raise PermissionError(13, "Permission denied", str(path))
        return iterdir(path)

    monkeypatch.setattr(Path, "iterdir", deny)
    models = load_model_set(store)
    reason = "the folder of model 'other' cannot be read: Permission denied"
    assert models.failure.reason == reason
    assert models.resolve("default").manifest.name == "tiny"
    with refused("unreadable"):
        models.resolve("other")


VERSIONS = {"rooms": ("1.0.0", "1.9.0", "1.10.0"), "halls": ("0.1.0",)}
ALIASES = {
    "default": AliasTarget(name="rooms"),
    "stable": AliasTarget(name="rooms", version="1.9.0"),
    "gone": AliasTarget(name="rooms", version="7.0.0"),
    "lost": AliasTarget(name="attic"),
    "halls": AliasTarget(name="rooms", version="1.0.0"),
}

INVALID = [
    *("", "@1.0.0", "rooms@", "rooms@latest", "rooms@1.0.0@1.0.0", "rooms@1.0.0\n"),
    *("../rooms", "Rooms", "a" * 65, "<script>"),
]


def resolve(reference: str) -> tuple[str, str]:
    return resolve_reference(reference, ALIASES, lambda name: VERSIONS.get(name, ()))


@pytest.mark.parametrize(
    ("reference", "version"),
    [
        ("rooms", "1.10.0"),
        ("rooms@1.9.0", "1.9.0"),
        ("default", "1.10.0"),
        ("stable", "1.9.0"),
        ("halls", "1.0.0"),  # an alias goes before a model of its name
    ],
)
def test_resolves(reference: str, version: str) -> None:
    assert resolve(reference) == ("rooms", version)


@pytest.mark.parametrize(
    ("reference", "code"),
    [
        ("attic", "unknown_model"),
        ("attic@1.0.0", "unknown_model"),
        ("rooms@1.0.1", "unknown_version"),
        ("gone", "dangling_alias"),
        ("lost", "dangling_alias"),
        *((reference, "invalid_reference") for reference in INVALID),
    ],
)
def test_refuses(reference: str, code: str) -> None:
    with refused(code) as raised:
        resolve(reference)
    assert "script" not in str(raised.value), "a reason does not repeat an invalid reference"


TERMS = "Any use, with the sources named."
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
