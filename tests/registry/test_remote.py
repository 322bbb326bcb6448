"""Remote stores, against an S3 server over HTTP."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from uuid import uuid4

import pytest

from app.registry import AliasTarget, ArtifactError, Store, StoreError, load_model_set
from app.registry.__main__ import main
from app.registry.index import Index, Signer, read_index, write_index
from app.registry.location import is_url, open_for_publisher, open_store
from app.registry.remote import RemoteStore
from tests.registry.object_storage import ObjectStorage, running, use
from tests.registry.small_artifacts import description, state

Remote = tuple[ObjectStorage, str, Path]


@pytest.fixture(scope="module")
def storage() -> Iterator[ObjectStorage]:
    with running() as storage:
        yield storage


@pytest.fixture
def url(storage: ObjectStorage, monkeypatch: pytest.MonkeyPatch) -> str:
    use(storage, monkeypatch)
    return storage.create_bucket(f"b{uuid4().hex}")


@pytest.fixture
def key(tmp_path: Path) -> Path:
    path = tmp_path / "key.pem"
    Signer.create(path)
    return path


@pytest.fixture
def publisher(url: str, key: Path, tmp_path: Path) -> RemoteStore:
    return opened(url, tmp_path / "publisher", signing_key=key)


@pytest.fixture
def replica(url: str, key: Path, tmp_path: Path) -> RemoteStore:
    """A replica that has read two versions, 1.0.0 and 1.1.0, and the alias `default`."""
    publisher = opened(url, tmp_path / "publisher", signing_key=key)
    publish(publisher, "1.0.0", alias="default")
    publish(publisher, "1.1.0")
    return synced(reader(url, key, tmp_path / "replica"))


def opened(url: str, cache: Path, **settings: object) -> RemoteStore:
    store = open_store(url, cache=cache, **settings)  # type: ignore[arg-type]
    assert isinstance(store, RemoteStore)
    return store


def reader(url: str, key: Path, cache: Path, **settings: object) -> RemoteStore:
    return opened(url, cache, trusted=[Signer.read(key).public], **settings)


def synced(store: RemoteStore) -> RemoteStore:
    store.sync()
    return store


def publish(store: Store, version: str, alias: str | None = None, name: str = "home") -> None:
    store.publish(description(name=name, version=version), state(), alias=alias)


def change_index(storage: ObjectStorage, url: str, key: Path | None, **members: object) -> Index:
    """Replace the index as a publisher with this key would."""
    index = read_index(storage.get(url, "index.json"), None).changed(**members)
    signer = None if key is None else Signer.read(key)
    storage.put(url, "index.json", write_index(index, signer))
    return index


def error_of(store: RemoteStore, version: str) -> str:
    with pytest.raises(ArtifactError) as error:
        store.load("home", version)
    return error.value.code


@pytest.mark.parametrize(
    ("location", "valid"),
    [
        ("s3://models", True),
        ("gs://models/a/b", True),
        ("az://models/a_b-c.d/", True),
        ("file:///etc", False),
        ("http://example.org/x", False),
        ("simplecache::s3://models", False),
        ("s3://user:password@models", False),
        ("s3://models?versionId=1", False),
        ("s3://", False),
        ("model_store", False),
    ],
)
def test_only_urls_of_object_storage_are_remote(location: str, valid: bool) -> None:
    assert is_url(location) is valid


def test_a_replica_serves_what_was_published(replica: RemoteStore) -> None:
    assert replica.error is None
    models = load_model_set(replica)
    assert list(models.entries) == [("home", "1.0.0"), ("home", "1.1.0")]
    assert models.resolve("default").manifest.version == "1.0.0"
    assert replica.root.parent.stat().st_mode & 0o777 == 0o700


def test_an_unchanged_index_changes_nothing(replica: RemoteStore) -> None:
    before = replica.state()
    replica.sync()
    assert replica.state() == before


def test_an_alias_move_reaches_the_replica(replica: RemoteStore, publisher: RemoteStore) -> None:
    before = replica.state()
    publisher.set_alias("default", AliasTarget(name="home", version="1.1.0"))
    replica.sync()
    assert replica.state() != before
    assert replica.resolve("default") == ("home", "1.1.0")
    publisher.remove_alias("default")
    replica.sync()
    assert not replica.aliases()


def test_the_expected_target_of_an_alias_is_checked(
    replica: RemoteStore, publisher: RemoteStore
) -> None:
    with pytest.raises(StoreError, match="alias_conflict"):
        publisher.set_alias("default", AliasTarget(name="home"), expected=None)
    with pytest.raises(StoreError, match="unknown_version"):
        publisher.set_alias("default", AliasTarget(name="home", version="9.0.0"))


def test_a_replica_without_a_key_cannot_write(replica: RemoteStore) -> None:
    with pytest.raises(StoreError, match="not_writable"):
        replica.set_alias("default", AliasTarget(name="home"))


def test_a_version_is_published_once(replica: RemoteStore, publisher: RemoteStore) -> None:
    with pytest.raises(StoreError, match="version_exists"):
        publish(publisher, "1.0.0")


def test_an_interrupted_publication_can_be_repeated(
    storage: ObjectStorage, url: str, publisher: RemoteStore, tmp_path: Path
) -> None:
    local = Store(tmp_path / "local")
    publish(local, "1.0.0")
    artifact = local.load("home", "1.0.0")
    storage.put(url, "home/1.0.0/card.md", artifact.card.encode())
    publisher.upload(artifact)
    assert synced(publisher).load("home", "1.0.0").digest == artifact.digest


def test_files_of_another_publication_are_never_replaced(
    storage: ObjectStorage, url: str, publisher: RemoteStore
) -> None:
    storage.put(url, "home/1.0.0/card.md", b"another")
    with pytest.raises(StoreError, match="version_exists"):
        publish(publisher, "1.0.0")


def test_publishers_at_once_lose_nothing(url: str, key: Path, tmp_path: Path) -> None:
    def work(number: int) -> None:
        publish(opened(url, tmp_path / f"p{number}", signing_key=key), f"1.{number}.0")

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(work, range(4)))
    found = synced(reader(url, key, tmp_path / "replica"))
    assert found.versions("home") == ("1.0.0", "1.1.0", "1.2.0", "1.3.0")


# -- hostile and broken stores ----------------------------------------------------------------


@pytest.mark.parametrize("signed_by", ["nobody", "a stranger"])
def test_an_index_without_a_trusted_signature_is_refused(
    signed_by: str, storage: ObjectStorage, url: str, replica: RemoteStore, tmp_path: Path
) -> None:
    other = None
    if signed_by == "a stranger":
        Signer.create(other := tmp_path / "other.pem")
    change_index(storage, url, other, aliases={})
    replica.sync()
    assert replica.error is not None
    assert replica.error.code == "untrusted_index"
    assert replica.resolve("default") == ("home", "1.0.0")
    assert replica.load("home", "1.1.0").manifest.version == "1.1.0"


def test_an_altered_index_is_refused(
    storage: ObjectStorage, url: str, replica: RemoteStore
) -> None:
    envelope = json.loads(storage.get(url, "index.json"))
    other = write_index(read_index(storage.get(url, "index.json"), None).changed(aliases={}), None)
    envelope["payload"] = json.loads(other)["payload"]
    storage.put(url, "index.json", json.dumps(envelope).encode())
    replica.sync()
    assert replica.error is not None
    assert replica.error.code == "untrusted_index"


def test_an_older_index_is_refused(
    storage: ObjectStorage, url: str, key: Path, replica: RemoteStore, tmp_path: Path
) -> None:
    old = storage.get(url, "index.json")
    change_index(storage, url, key, aliases={})
    replica.sync()
    storage.put(url, "index.json", old)
    # A restart must not forget the counter.
    for store in (replica, reader(url, key, tmp_path / "replica")):
        store.sync()
        assert store.error is not None
        assert store.error.code == "rolled_back"
        assert not store.aliases()
        assert store.versions("home") == ("1.0.0", "1.1.0")


def test_a_revoked_version_is_not_served(replica: RemoteStore, publisher: RemoteStore) -> None:
    publisher.revoke("home", "1.1.0", "wrong labels")
    replica.sync()
    assert error_of(replica, "1.1.0") == "revoked"
    assert replica.load("home", "1.0.0").manifest.version == "1.0.0"
    assert not (replica.root / "home" / "1.1.0").exists()


def test_the_version_of_an_alias_cannot_be_revoked(
    replica: RemoteStore, publisher: RemoteStore
) -> None:
    with pytest.raises(StoreError, match="alias_conflict"):
        publisher.revoke("home", "1.0.0", "wrong labels")
    publisher.set_alias("newest", AliasTarget(name="home"))
    with pytest.raises(StoreError, match="alias_conflict"):
        publisher.revoke("home", "1.1.0", "wrong labels")


@pytest.mark.parametrize(
    ("file", "data", "code"),
    [
        ("manifest.json", b"{}", "checksum_mismatch"),
        ("manifest.json", b"x" * (4 * 2**20 + 1), "too_large"),
        ("model.safetensors", b"short", "truncated"),
        ("card.md", b"x" * 2**20, "too_large"),
        ("card.md", None, "missing_file"),
    ],
)
def test_a_broken_version_is_refused_and_the_others_served(
    file: str,
    data: bytes | None,
    code: str,
    storage: ObjectStorage,
    url: str,
    key: Path,
    replica: RemoteStore,
    tmp_path: Path,
) -> None:
    if data is None:
        storage.delete(url, f"home/1.1.0/{file}")
    else:
        storage.put(url, f"home/1.1.0/{file}", data)
    fresh = synced(reader(url, key, tmp_path / "fresh"))
    assert fresh.error is None
    assert error_of(fresh, "1.1.0") == code
    assert fresh.load("home", "1.0.0").manifest.version == "1.0.0"
    # The replica has its own copy and never downloads a version twice.
    replica.sync()
    assert replica.load("home", "1.1.0").manifest.version == "1.1.0"


def test_the_cache_has_a_maximum_size(
    url: str, key: Path, replica: RemoteStore, tmp_path: Path
) -> None:
    used = sum(file.stat().st_size for file in (replica.root / "home" / "1.0.0").iterdir())
    fresh = reader(url, key, tmp_path / "fresh", max_cache_bytes=used + 100)
    fresh.sync()
    codes = []
    for version in fresh.versions("home"):
        try:
            fresh.load("home", version)
        except ArtifactError as error:
            codes.append(error.code)
    assert codes == ["too_large"]


def test_a_replica_serves_its_copy_while_the_server_is_down(
    storage: ObjectStorage, url: str, key: Path, replica: RemoteStore, tmp_path: Path
) -> None:
    storage.stop()
    try:
        for store in (replica, reader(url, key, tmp_path / "replica")):
            store.sync()
            assert store.error is not None
            assert store.error.code == "unreachable"
            assert load_model_set(store).resolve("default").manifest.version == "1.0.0"
        fresh = synced(reader(url, key, tmp_path / "fresh"))
        assert fresh.names() == ()
    finally:
        storage.start()
    replica.sync()
    assert replica.error is None


def test_a_deleted_or_damaged_cache_is_rebuilt(
    url: str, key: Path, replica: RemoteStore, tmp_path: Path
) -> None:
    file = replica.root / "home" / "1.0.0" / "model.safetensors"
    file.write_bytes(file.read_bytes()[:-1])
    assert error_of(replica, "1.0.0") == "truncated"
    replica.sync()
    assert replica.load("home", "1.0.0").manifest.version == "1.0.0"
    shutil.rmtree(replica.root.parent)
    replica.sync()
    assert replica.error is None
    assert load_model_set(replica).resolve("default").manifest.version == "1.0.0"
    again = synced(reader(url, key, tmp_path / "again"))
    assert again.load("home", "1.0.0").digest == replica.load("home", "1.0.0").digest


def test_a_publisher_does_not_build_on_an_older_index(
    storage: ObjectStorage, url: str, replica: RemoteStore, publisher: RemoteStore
) -> None:
    old = storage.get(url, "index.json")
    publisher.set_alias("default", AliasTarget(name="home", version="1.1.0"))
    publisher.sync()
    storage.put(url, "index.json", old)
    with pytest.raises(StoreError, match="rolled_back"):
        publisher.set_alias("other", AliasTarget(name="home"))


def test_a_version_that_was_replaced_is_downloaded_again(
    storage: ObjectStorage, url: str, key: Path, replica: RemoteStore, tmp_path: Path
) -> None:
    """The owner may have emptied the bucket, and published other files under the same version."""
    replica.load("home", "1.0.0")
    local = Store(tmp_path / "other")
    local.publish(description(name="home", version="1.0.0"), state(seed=5))
    artifact = local.load("home", "1.0.0")
    for file in artifact.path.iterdir():
        storage.put(url, f"home/1.0.0/{file.name}", file.read_bytes())
    change_index(storage, url, key, versions={"home@1.0.0": artifact.digest})
    replica.sync()
    assert error_of(replica, "1.0.0") == "checksum_mismatch"
    replica.sync()
    assert replica.load("home", "1.0.0").digest == artifact.digest


# -- the command --------------------------------------------------------------------------------


def test_the_command_publishes_and_rolls_back(
    url: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def run(*arguments: str, status: int = 0) -> str:
        assert main(list(arguments)) == status
        captured = capsys.readouterr()
        return captured.out + captured.err

    monkeypatch.setenv("SCENE_STORE", url)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    local = Store(tmp_path / "local")
    publish(local, "1.0.0")
    publish(local, "1.1.0")
    key = tmp_path / "signing.pem"
    public = run("key", str(key)).split()[-1]
    assert key.stat().st_mode & 0o777 == 0o600
    assert "signing key" in run("key", str(key), status=1)
    assert "SCENE_SIGNING_KEY" in run("upload", "home", "--from", str(local.root), status=1)

    monkeypatch.setenv("SCENE_SIGNING_KEY", str(key))
    run("upload", "home@1.0.0", "home@1.1.0", "--from", str(local.root), "--alias", "default")
    run("alias", "default", "home@1.0.0")
    assert "alias_conflict" not in run("revoke", "home@1.1.0", "wrong labels")
    assert "default" in run("revoke", "home@1.0.0", "wrong labels", status=1)

    monkeypatch.delenv("SCENE_SIGNING_KEY")
    monkeypatch.setenv("SCENE_TRUSTED_KEYS", public)
    listed = run("list").splitlines()
    assert listed[0] == "home@1.0.0"
    assert listed[1].startswith("home@1.1.0  refused: revoked")
    assert listed[2] == "default -> home@1.0.0"
    assert "name@version" in run("revoke", "home", "why", status=1)


def test_the_store_of_a_publisher_needs_a_key(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SCENE_TRUSTED_KEYS", "abc")
    with pytest.raises(StoreError, match="invalid_key"):
        open_for_publisher(url)
