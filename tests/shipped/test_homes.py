"""Alarms in a home: what is normal there raises few, and an intruder is still found.

The lists of `homes.toml` are asked with and without the room type, with the guesses of
`nearest-or-ignore`. The bounds are the counts of the shipped version.
"""

import json
import tomllib
from pathlib import Path

import pytest

from scene_client import OfflineClient
from tests.conftest import REPOSITORY

HOMES = tomllib.loads((Path(__file__).parent / "homes.toml").read_text(encoding="utf-8"))
FLAT = REPOSITORY.parent / "shared" / "field" / "flat.json"
WITH_ROOM = {False: "without the room type", True: "with the room type"}


@pytest.fixture(scope="module")
def client():
    with OfflineClient(str(REPOSITORY / "model_store")) as client:
        yield client


@pytest.fixture(params=WITH_ROOM, ids=WITH_ROOM.get)
def flagged(request, client):
    """A function of a room and labels: the ids of the flagged objects."""

    def ask(room: str, labels: list[str]) -> list[str]:
        given = {"room_type": room} if request.param else {}
        things = [{"id": f"{k} {label}", "label": label} for k, label in enumerate(labels)]
        answer = client.outliers(things, unknown_labels="nearest-or-ignore", **given)
        return [one.object for one in answer.outliers if one.is_outlier]

    return ask, request.param


# Lists with an alarm, of 92, and flagged intruders, of 45.
BOUNDS = {False: (0, 34), True: (2, 38)}


def test_alarms_of_homes(flagged):
    ask, with_room = flagged
    normal = [bool(ask(room, labels)) for room, labels in HOMES["normal"]]
    found = [
        f"{len(labels) - 1} {labels[-1]}" in ask(room, labels)
        for room, labels in HOMES["intruders"]
    ]
    most, least = BOUNDS[with_room]
    assert sum(normal) <= most
    assert sum(found) >= least


@pytest.mark.parametrize("kind", HOMES["things"])
def test_toys_lamps_pets_and_plants_are_normal(flagged, kind):
    ask, _ = flagged
    alarms = [
        (thing, room)
        for thing in HOMES["things"][kind]
        for room, labels in HOMES["rooms"].items()
        if ask(room, [*labels, thing])
    ]
    assert len(alarms) <= {"lamps": 3, "plants": 4}.get(kind, 0), alarms


def test_a_real_flat_raises_at_most_one_alarm(flagged):
    if not FLAT.is_file():
        pytest.skip("the lists of the flat are not here")
    ask, _ = flagged
    lists = json.loads(FLAT.read_text(encoding="utf-8"))
    assert len(lists) == 16
    alarms = [alarm for entry in lists for alarm in ask(entry["room"], entry["objects"])]
    assert len(alarms) <= 1, alarms
