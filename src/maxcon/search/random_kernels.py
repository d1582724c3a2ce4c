"""Random numbers inside kernels, the same with and without JIT.

A numpy Generator cannot enter a kernel, so its place is taken by sfc32 ("small fast counting", C.
Doty-Humphrey, PractRand 0.93, 2010): four 32-bit words, additions, shifts and exclusive ors only. The words
live in int64, masked to 32 bits: nothing ever overflows, so that interpreted NumPy scalars and compiled code
agree to the last bit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel

_MASK = 0xFFFFFFFF
_WARM_UP = 15  # rounds after which three seeded words have mixed (PractRand)


def seed_state(rng: np.random.Generator) -> NDArray[np.int64]:
    """Return the state of a new stream, shape (4,), seeded by 96 bits drawn from `rng`."""
    state = np.ones(4, dtype=np.int64)
    state[:3] = rng.integers(0, 2**32, size=3)
    for _ in range(_WARM_UP):
        next_bits(state)
    return state


@kernel
def next_bits(state: NDArray[np.int64]) -> int:
    """Return 32 random bits, an integer in [0, 2**32), and advance `state`."""
    a, b, c = state[0], state[1], state[2]
    bits: int = (a + b + state[3]) & _MASK
    state[3] = (state[3] + 1) & _MASK
    state[0] = b ^ (b >> 9)
    state[1] = (c + (c << 3)) & _MASK
    state[2] = ((((c << 21) | (c >> 11)) & _MASK) + bits) & _MASK
    return bits


@kernel
def random_below(state: NDArray[np.int64], n: int) -> int:
    """Return a random integer in [0, n), 0 < n < 2**31, with a bias below n / 2**32 (Lemire 2019)."""
    return (next_bits(state) * n) >> 32


@kernel
def random_unit(state: NDArray[np.int64]) -> float:
    """Return a random float in [0, 1), a multiple of 2**-32."""
    return next_bits(state) * 2.3283064365386963e-10


@kernel
def draw_next(state: NDArray[np.int64], pool: NDArray[np.int64], place: int, size: int) -> int:
    """Draw one of ``pool[place:size]`` uniformly, swap it to ``pool[place]`` and return it.

    With place = 0, 1, 2, ... this samples without replacement (Fisher-Yates). `pool` stays a permutation of
    itself, so that it need never be reset.
    """
    other = place + random_below(state, size - place)
    drawn: int = pool[other]
    pool[other] = pool[place]
    pool[place] = drawn
    return drawn
