"""The loaded snapshot: reused artifacts, refused versions, and unreadable stores."""

import shutil
from collections.abc import Mapping
from pathlib import Path

import pytest

from app.registry import AliasTarget, ArtifactError, Store, load_model_set
from app.registry.references import resolve_reference
from tests.registry.small_artifacts import description, publish_as, refused, state


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
