"""Random numbers by counting: Philox4x32-10, in compiled loops.

Each word is a function of a key and a counter, so a stream is a few numbers that belong to whoever
draws: there is no state to share, and what one request draws cannot depend on another. Sixteen
counters are worked on at a time.

Source: Salmon, Moraes, Dror and Shaw, "Parallel random numbers: as easy as 1, 2, 3" (2011).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from app.compiling import compiled

Stream = NDArray[np.uint64]
"""(5,): how many draws were made, two more words of the counter, and the two of the key."""

_ROUNDS = 10
_LOW, _HALF = np.uint64(0xFFFFFFFF), np.uint64(32)
_FACTOR, _OTHER_FACTOR = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_STEP, _OTHER_STEP = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)


def stream(seed: int, place: int) -> Stream:
    """A stream of its own for each place of each seed.

    Args:
        seed: any number from 0.
        place: from 0; those of one seed are as independent as those of two.
    """
    words = np.random.SeedSequence(seed, spawn_key=(place,)).generate_state(4, np.uint32)
    return np.array([0, *words.tolist()], dtype=np.uint64)


@compiled
def fill(stream, words):
    """Draw anew: all of words, (n,) uint32 with n a multiple of 4."""
    blocks = len(words) // 4
    first, second = words[:blocks], words[blocks : 2 * blocks]
    third, fourth = words[2 * blocks : 3 * blocks], words[3 * blocks :]
    for block in range(blocks):
        a, b = np.uint64(block), stream[0] & _LOW
        c, d = stream[1] & _LOW, stream[2] & _LOW
        key, other_key = stream[3] & _LOW, stream[4] & _LOW
        for _ in range(_ROUNDS):
            product, other_product = _FACTOR * a, _OTHER_FACTOR * c
            a, b = (other_product >> _HALF) ^ b ^ key, other_product & _LOW
            c, d = (product >> _HALF) ^ d ^ other_key, product & _LOW
            key, other_key = (key + _STEP) & _LOW, (other_key + _OTHER_STEP) & _LOW
        first[block], second[block] = np.uint32(a), np.uint32(b)
        third[block], fourth[block] = np.uint32(c), np.uint32(d)
    stream[0] += np.uint64(1)
