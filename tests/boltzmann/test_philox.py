"""The counting generator against its authors' known answers."""

from __future__ import annotations

import numpy as np
import pytest

from app.inference import philox


def first_block(counter, key):
    """Words of block 0: the first word of the counter is the block's number."""
    words = np.empty(4, np.uint32)
    philox.fill(np.array([*counter[1:], *key], dtype=np.uint64), words)
    return words.tolist()


def philox_by_hand(counter, key):
    """One block, in Python's integers."""
    a, b, c, d = counter
    low = 0xFFFFFFFF
    for turn in range(10):
        steps = zip(key, (0x9E3779B9, 0xBB67AE85), strict=True)
        k = [(word + turn * step) & low for word, step in steps]
        first, second = 0xD2511F53 * a, 0xCD9E8D57 * c
        a, b, c, d = (second >> 32) ^ b ^ k[0], second & low, (first >> 32) ^ d ^ k[1], first & low
    return [a, b, c, d]


KNOWN = [
    ([0] * 4, [0] * 2, [0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8]),
    (
        [0xFFFFFFFF] * 4,
        [0xFFFFFFFF] * 2,
        [0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD],
    ),
    (
        [0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344],
        [0xA4093822, 0x299F31D0],
        [0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1],
    ),
]


@pytest.mark.parametrize(("counter", "key", "words"), KNOWN)
def test_known_answers(counter, key, words):
    assert philox_by_hand(counter, key) == words
    if counter[0] == 0:
        assert first_block(counter, key) == words


def test_every_block_of_every_draw_is_that_of_its_counter():
    state = philox.stream(7, 3)
    _, *rest = state.tolist()
    for draw in range(3):
        words = np.empty(4 * 37, np.uint32)
        philox.fill(state, words)
        for block in range(37):
            expected = philox_by_hand([block, draw, *rest[:2]], rest[2:])
            assert words[block::37].tolist() == expected


def test_streams_differ_by_seed_and_place_and_repeat():
    words = {
        (seed, place): tuple(philox.stream(seed, place).tolist())
        for seed in (0, 1, 2**53 - 1)
        for place in (0, 1, 63)
    }
    assert len(set(words.values())) == len(words)
    assert all(tuple(philox.stream(*key).tolist()) == found for key, found in words.items())
