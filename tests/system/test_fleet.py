"""Two replicas of one store behind the shipped proxy: promotions, a crash, a rolling update."""

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from app.registry import AliasTarget, Store
from scene_client import Client
from tests.chaos.load import REQUESTS, ConstantLoad, Judge
from tests.http.stores import make_store
from tests.services import PATIENCE, LiveService, free_port, launch, wait_until
from tests.system.conftest import Proxy, StartProxy

pytestmark = [pytest.mark.system, pytest.mark.slow]

PROMOTIONS = 30


class Fleet:
    """Two replicas behind a proxy, and the store that they follow."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.store = Store(make_store(folder / "store"))
        self.health = [free_port(), free_port()]
        self.replicas = [self.start(number) for number in range(2)]

    def start(self, number: int, port: int | None = None, **settings: str) -> LiveService:
        variables = {"SCENE_STORE_POLL": "0.2", "SCENE_DRAIN_SECONDS": "4", **settings}
        variables["SCENE_HEALTH_PORT"] = str(self.health[number])
        return launch(self.store.root, self.folder / f"log{number}", port=port, **variables)

    def promote(self, version: str) -> None:
        """Move the alias, and wait until both replicas serve the version."""
        self.store.set_alias("default", AliasTarget(name="home", version=version))
        wait_until(lambda: {self.default(replica) for replica in self.replicas} == {version})
        generations = {one.client.get("/models").json()["generation"] for one in self.replicas}
        assert len(generations) == 1

    @staticmethod
    def default(replica: LiveService) -> str:
        answer = replica.client.post("/missing", json={"objects": ["bed"]}).json()
        return str(answer["model"]["version"])

    def configuration(self, shipped: str) -> Path:
        template = next(line for line in shipped.splitlines() if "server-template" in line)
        servers = "".join(
            f"    server replica{number} 127.0.0.1:{replica.port} port {self.health[number]}\n"
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
def proxy(fleet: Fleet, haproxy: StartProxy, configuration: Path) -> Iterator[Proxy]:
    own = fleet.configuration(configuration.read_text())
    with haproxy(own, fleet.folder / "proxy", PROXY_REQUESTS="1000000") as proxy:
        yield proxy


@pytest.fixture
def load(fleet: Fleet, proxy: Proxy) -> ConstantLoad:
    """Requests whose answers must be exactly those of the version that they name."""
    judge = Judge(fleet.replicas[1].client, ("1.0.0", "1.1.0"))
    return ConstantLoad(proxy.port, REQUESTS, judge, connections=4)


def test_promotions_lose_nothing(fleet: Fleet, load: ConstantLoad) -> None:
    with load:
        for number in range(PROMOTIONS):
            fleet.promote(f"1.{number % 2}.0")


def test_rolling_updates_lose_nothing(fleet: Fleet, load: ConstantLoad, proxy: Proxy) -> None:
    with load:
        for number, old in enumerate(fleet.replicas):
            old.process.terminate()
            assert old.process.wait(timeout=PATIENCE) == -signal.SIGTERM
            old.client.close()
            settings = {"SCENE_MAX_OBJECTS": "9"}
            fleet.replicas[number] = fleet.start(number, old.port, **settings)
            noticed = f"replica{number} is UP"
            wait_until(lambda noticed=noticed: noticed in proxy.log.read_text(), proxy.log)
    for replica in fleet.replicas:
        answer = replica.client.post("/missing", json={"objects": ["bed"] * 10})
        assert answer.status_code == 422, answer.text


def test_the_client_hides_a_killed_replica(fleet: Fleet, proxy: Proxy) -> None:
    killed = fleet.replicas[0]
    with Client(proxy.address, timeout=60) as client:
        for number in range(300):
            if number == 100:
                killed.process.kill()
            client.missing(["bed", "lamp"])
    killed.process.wait()
