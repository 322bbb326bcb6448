import random
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from training.datasets import AnnotatedScene, split
from training.datasets.splits import FRACTIONS, Protocol, stable_part

ROOMS = ("bedroom", "kitchen", "office", None)


def collection(
    source: str, groups: int, seed: int = 0, prefix: str | None = None
) -> list[AnnotatedScene]:
    rng = random.Random(f"{source}{seed}")
    return [
        AnnotatedScene(f"{source}-{g}-{k}", source, f"{prefix or source}-{g}", room, ())
        for g in range(groups)
        for room in [rng.choices(ROOMS, (5, 3, 2, 1))[0]]
        for k in range(rng.randint(1, 6))
    ]


def parts_of(scenes: list[AnnotatedScene], **options: object) -> dict[str, str]:
    return {
        scene.scene_id: part
        for part, members in split(scenes, **options).items()  # type: ignore[arg-type]
        for scene in members
    }


@given(st.integers(0, 40), st.integers(0, 5), st.sampled_from(list(FRACTIONS)))
def test_every_scene_has_one_part_whatever_the_order(groups, seed, protocol):
    scenes = collection("a", groups)
    parts = split(scenes, seed=seed, protocol=protocol)
    ids = sorted(scene.scene_id for members in parts.values() for scene in members)
    assert ids == sorted(scene.scene_id for scene in scenes)
    shuffled = random.Random(seed).sample(scenes, len(scenes))
    found, again = (parts_of(x, seed=seed, protocol=protocol) for x in (scenes, shuffled))
    assert found == again


def divides_groups(scenes: list[AnnotatedScene], part_of: dict[str, str]) -> bool:
    parts = {(scene.group, part_of[scene.scene_id]) for scene in scenes}
    return len(parts) > len({scene.group for scene in scenes})


@given(st.integers(1, 60), st.integers(0, 5), st.sampled_from(sorted(FRACTIONS.keys() - {"paper"})))
def test_groups_stay_whole_across_sources(groups: int, seed: int, protocol: Protocol) -> None:
    frames = collection("frames", groups, prefix="place")
    boxes = collection("boxes", groups // 2, seed=1, prefix="place")
    found = parts_of([*frames, *boxes], seed=seed, protocol=protocol)
    assert not divides_groups([*frames, *boxes], found)


def test_a_source_splits_alone_as_it_does_among_others() -> None:
    frames = collection("frames", 80, prefix="place")
    boxes = collection("boxes", 20, seed=1, prefix="place")
    other = collection("other", 50)
    together = parts_of([*other, *frames, *boxes], seed=3)
    alone = parts_of(frames, seed=3) | parts_of(other, seed=3)
    assert {key: part for key, part in together.items() if key in alone} == alone


@pytest.mark.parametrize("protocol", ["group", "paper", "paper groups", "final"])
def test_shares_hold_over_all_and_within_room_types(protocol: Protocol) -> None:
    scenes = collection("a", 400)
    parts = split(scenes, seed=1, protocol=protocol)
    assert list(parts) == ["train", "test", "validation"]
    room_size = Counter(scene.room_type for scene in scenes)
    for part, fraction in FRACTIONS[protocol].items():
        # A part is off by at most the scenes of a group in each stratum.
        assert len(parts[part]) == pytest.approx(fraction * len(scenes), abs=8)
        here = Counter(scene.room_type for scene in parts[part])
        for room, size in room_size.items():
            assert here[room] == pytest.approx(fraction * size, abs=8)


def test_scenes_of_rare_room_types_occur_in_all_parts() -> None:
    scenes = [AnnotatedScene(str(k), "a", str(k), f"room {k}", ()) for k in range(40)]
    sizes = {part: len(members) for part, members in split(scenes, seed=0).items()}
    assert sizes == {"train": 30, "test": 6, "validation": 4}


def test_the_final_split_divides_written_places_alone() -> None:
    written, real = collection("inventories", 60), collection("a", 60)
    found = parts_of([*written, *real], seed=0, protocol="final")
    assert divides_groups(written, found)
    assert not divides_groups(real, found)
    assert not divides_groups(written, parts_of([*written, *real], seed=0))


def test_the_split_of_the_paper_divides_groups() -> None:
    scenes = collection("a", 60)
    assert divides_groups(scenes, parts_of(scenes, seed=0, protocol="paper"))


def test_a_stable_split_has_its_shares_and_moves_no_group_as_the_data_grow() -> None:
    scenes = collection("a", 2000)
    found = parts_of(scenes, seed=3, protocol="stable")
    counts = Counter(found.values())
    for part, fraction in FRACTIONS["stable"].items():
        assert counts[part] / len(scenes) == pytest.approx(fraction, abs=0.03)
    fewer = parts_of(scenes[::7] + collection("b", 40), seed=3, protocol="stable")
    shared = set(fewer) & set(found)
    assert len(shared) > 900
    assert all(fewer[scene] == found[scene] for scene in shared)
    assert all(found[scene.scene_id] == stable_part(scene, 3) for scene in scenes)
    assert found != parts_of(scenes, seed=4, protocol="stable")


def test_unknown_protocols_and_repeated_ids_are_refused() -> None:
    scenes = collection("a", 3)
    with pytest.raises(ValueError, match="protocol must be"):
        split(scenes, seed=0, protocol="house")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="have the same scene_id"):
        split([*scenes, scenes[0]], seed=0)
