"""Two replicas of one store behind the shipped proxy: promotions, a crash, a rolling update."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from app.registry import AliasTarget, Store
from scene_client import Client
from tests.chaos.load import REQUESTS, ConstantLoad, Judge
from tests.http.stores import make_store
from tests.services import LiveService, is_ready, launch, wait_until
from tests.system.conftest import StartProxy

pytestmark = [pytest.mark.system, pytest.mark.slow]

PROMOTIONS = 30
POLL = 0.5
NOTICED = 2.5
"""Seconds within which the proxy has noticed that a replica is ready: it asks every two."""


class Fleet:
    """Two replicas behind a proxy, and the store that they follow."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.store = Store(make_store(folder / "store"))
        self.replicas = [self.start(number) for number in range(2)]

    def start(self, number: int, port: int | None = None, **settings: str) -> LiveService:
        variables = {"SCENE_STORE_POLL": str(POLL), "SCENE_DRAIN_SECONDS": "4", **settings}
        return launch(self.store.root, self.folder / f"log{number}", port=port, **variables)

    def promote(self, version: str) -> None:
        """Move the alias, and wait until both replicas serve the version."""
        self.store.set_alias("default", AliasTarget(name="home", version=version))
        wait_until(lambda: all(self.default(replica) == version for replica in self.replicas))
        generations = {
            replica.client.get("/models").json()["generation"] for replica in self.replicas
        }
        assert len(generations) == 1

    @staticmethod
    def default(replica: LiveService) -> str:
        answer = replica.client.post("/missing", json={"objects": ["bed"]}).json()
        return str(answer["model"]["version"])

    def configuration(self, shipped: str) -> Path:
        """The shipped configuration with these replicas as servers."""
        template = next(line for line in shipped.splitlines() if "server-template" in line)
        servers = "".join(
            f"    server replica{number} 127.0.0.1:{replica.port}\n"
            for number, replica in enumerate(self.replicas)
        )
        path = self.folder / "haproxy.cfg"
        path.write_text(shipped.replace(template, servers))
        return path


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    fleet = Fleet(tmp_path_factory.mktemp("fleet"))
    yield fleet
    for replica in fleet.replicas:
        replica.stop()


@pytest.fixture(scope="module")
def port(fleet: Fleet, haproxy: StartProxy, configuration: Path) -> Iterator[int]:
    own = fleet.configuration(configuration.read_text())
    with haproxy(own, fleet.folder / "proxy", PROXY_REQUESTS="1000000") as proxy:
        yield proxy.port


@pytest.fixture
def load(fleet: Fleet, port: int) -> ConstantLoad:
    """Requests whose answers must be exactly those of the version that they name."""
    judge = Judge(fleet.replicas[1].client, ("1.0.0", "1.1.0"))
    return ConstantLoad(port, REQUESTS, judge, connections=4)


def test_promotions_under_load_lose_and_mix_nothing(fleet: Fleet, load: ConstantLoad) -> None:
    with load:
        for number in range(PROMOTIONS):
            fleet.promote(f"1.{number % 2}.0")
    load.tally.check()


def test_a_rolling_update_of_the_settings_loses_and_mixes_nothing(
    fleet: Fleet, load: ConstantLoad
) -> None:
    with load:
        for number, old in enumerate(fleet.replicas):
            time.sleep(NOTICED)
            old.process.terminate()
            assert old.process.wait(timeout=30) == -signal.SIGTERM
            old.client.close()
            settings = {"SCENE_MAX_OBJECTS": "9"}
            fleet.replicas[number] = fleet.start(number, old.port, **settings)
            wait_until(lambda port=old.port: is_ready(port))
    load.tally.check()
    for replica in fleet.replicas:
        answer = replica.client.post("/missing", json={"objects": ["bed"] * 10})
        assert answer.status_code == 422, answer.text


def test_the_client_hides_a_killed_replica(fleet: Fleet, port: int) -> None:
    killed = fleet.replicas[0]
    with Client(f"http://127.0.0.1:{port}") as client:
        for number in range(300):
            if number == 100:
                killed.process.kill()
            client.missing(["bed", "lamp"])
    killed.process.wait()
