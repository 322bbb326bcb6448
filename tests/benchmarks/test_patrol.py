"""Patrols: random flats, the noise of the detector, and the counts of the judge."""

import math

import pytest

from benchmarks.patrol import judge
from benchmarks.patrol.flats import ROOMS, SIZES, random_flat
from benchmarks.patrol.judge import Counts, Row
from benchmarks.patrol.robot import Noise, own_world
from tests.client.homes import FakeClient


@pytest.mark.parametrize("seed", range(6))
def test_flats(seed):
    flat = random_flat(seed)
    assert flat == random_flat(seed) != random_flat(seed + 1)
    assert len(flat.rooms) == 5
    assert set(flat.rooms) <= set(ROOMS)
    assert sorted(one.room for one in flat.things if one.is_intruder) == sorted(flat.rooms)
    assert len({one.id for one in flat.things}) == len(flat.things) >= 40
    for one in flat.things:
        x0, y0, x1, y1 = flat.rooms[one.room]
        assert x0 < one.place[0] < x1
        assert y0 < one.place[1] < y1
        assert one.size == SIZES[one.label]


def test_the_noise_of_the_detector():
    quiet = own_world(0, Noise(0, 0, 0), 1)
    label = {one.id: one.label for one in quiet.flat.things}
    for _, room, pose, seen in quiet.frames:
        assert {one.true for one in seen} == {one.id for one in quiet.visible(room, pose)}
        assert all(one.label == label[one.true] for one in seen)
    total = sum(len(seen) for *_, seen in quiet.frames)
    missed = own_world(0, Noise(0.3, 0, 0), 1)
    assert sum(len(s) for *_, s in missed.frames) / total == pytest.approx(0.7, abs=0.05)
    ghosts = own_world(0, Noise(0, 0.15, 0), 1)
    assert any(one.true is None for *_, seen in ghosts.frames for one in seen)
    swaps = own_world(0, Noise(0, 0, 0.2, has_alternatives=True), 1)
    wrong = [one for *_, seen in swaps.frames for one in seen if one.label != label[one.true]]
    assert 0.1 < len(wrong) / total < 0.2
    assert all(one.other == label[one.true] for one in wrong)


def test_the_counts():
    world = own_world(0, Noise(0, 0, 0), 1)
    room = next(iter(world.flat.rooms))
    intruder = next(t.id for t in world.flat.things if t.is_intruder and t.room == room)
    other = next(t.id for t in world.flat.things if not t.is_intruder and t.room == room)
    right, wrong = (
        {(intruder, "out-of-place")},
        {(other, "out-of-place"), ("ghost t9", "misplaced")},
    )
    alarms = [set(), right, right | wrong, right, right, right | {("ghost t8", "out-of-place")}]
    labels = dict.fromkeys((intruder, other, "ghost t9", "ghost t8"), "label")
    rows = [
        Row(0, room, {intruder}, second > 0, room if second > 2 else "attic", on, labels, [])
        for second, on in enumerate(alarms)
    ]
    sums = Counts()
    judge.count(rows, world, sums)
    assert (sums.seconds, sums.right, sums.wrong) == (6, 5, 2)
    assert dict(sums.onsets) == {"real": 1, "ghost": 1, "place": 1}
    assert sums.changes == 3  # on and off of the real object, on of the ghost
    assert (sums.found, sums.in_view) == ([1], [2])
    assert (sums.known, sums.room_right, sums.room_changes) == (5, 3, 1)


@pytest.mark.parametrize("situation", ["full", "poses", "labels"])
def test_a_patrol_finds_all_things_and_no_others(situation):
    world = own_world(1, Noise(), 2)
    client = FakeClient()
    client.odd = {"person", "cat", "dog", "bicycle"}  # only phantoms have these labels
    sums = Counts()
    rows = judge.drive(client, world, situation)
    judge.count(rows, world, sums)
    assert sums.onsets["ghost"] == 0
    things = len(world.flat.things)
    appeared = sums.events["appeared"] - sums.events["gone"]
    assert math.isclose(appeared, things, rel_tol=0.1)
