"""Counter-based random numbers, and exponential variates with the same bits on every device.

Philox4x32-10 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011) maps a counter of four 32-bit
words under a key of two to four random words. The layout that every sampler of this project uses:

=========  ==================================================================================
word       value
=========  ==================================================================================
counter 0  the place: pixel id, tile number (see `draws`), view number, or row; 0 where there is none
counter 1  the training view's number; 0 where the place is a view or a row, or there is none
counter 2  the purpose, one of `PURPOSE_*`
counter 3  the high 32 bits of the seed
key 0      the low 32 bits of the seed
key 1      the iteration, modulo 2^32
=========  ==================================================================================

One call gives the four words ``x0 .. x3`` of a place; each caller says which word it uses for what.

A uniform number in (0, 1) is ``u = (2 * (x >> 9) + 1) * 2^-24``: an odd multiple of 2^-24, exact in single precision
and never 0 or 1. (With 24 random bits it would need 25 bits, and could round to 1.)
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from turbogs_plugin.types import Step

PURPOSE_PIXELS, PURPOSE_TILES = 0, 2  # 1 is not in use
PURPOSE_VIEWS, PURPOSE_STACK, PURPOSE_BACKGROUND, PURPOSE_GROWTH, PURPOSE_DROPOUT = range(3, 8)

MASK = 0xFFFFFFFF
ROUNDS = 10
MULTIPLIERS = (0xD2511F53, 0xCD9E8D57)
WEYL = (0x9E3779B9, 0xBB67AE85)

LOG_2 = 0.693147182464599609375  # float32 0x3f317218
SQRT_HALF_BITS = 0x3F3504F3  # the float32 nearest to sqrt(1/2)
LOG_COEFFICIENTS = (2 / 3, 2 / 5, 2 / 7, 2 / 9)  # of s^3, s^5, s^7, s^9 in 2 * atanh(s); each rounded to float32

_BLOCK = 64
"""The host's words are made for this many iterations at once, which costs numpy the same as for one."""

Words = tuple[Tensor, Tensor, Tensor, Tensor]


def philox4x32(counter: Iterable[Any], key: tuple[Any, Any]) -> tuple[Any, Any, Any, Any]:
    """Philox4x32-10: four int64 tensors (or numpy arrays) of values 0 .. 2^32 - 1.

    Args:
        counter: four more of these; the first has the shape of the result, the others broadcast to it, or are numbers.
        key: two such numbers, or arrays of them that broadcast to the first counter.
    """
    c0, c1, c2, c3 = counter
    c2 = c2 + 0 * c0
    k0, k1 = key
    for _ in range(ROUNDS):
        # A product of two 32-bit words wraps in int64, but keeps all of its 64 bits. In place, for speed on the CPU.
        product0, product1 = c0 * MULTIPLIERS[0], c2 * MULTIPLIERS[1]
        high0, high1 = product0 >> 32, product1 >> 32
        for high, word, key_word in ((high1, c1, k0), (high0, c3, k1)):
            high &= MASK
            high ^= word
            high ^= key_word
        product0 &= MASK
        product1 &= MASK
        c0, c1, c2, c3 = high1, product1, high0, product0
        k0, k1 = (k0 + WEYL[0]) & MASK, (k1 + WEYL[1]) & MASK
    return c0, c1, c2, c3


def random_words(place: Tensor, view: Tensor | int, purpose: int, seed: int, iteration: int) -> Words:
    """The four random words of each place, in the layout above. `place`: int64, any shape, values 0 .. 2^32 - 1;
    `view`: int64 tensor that broadcasts to `place`, or a number."""
    return philox4x32((place, view, purpose, seed >> 32 & MASK), (seed & MASK, iteration & MASK))


def host_words(purpose: int, places: int, step: Step) -> tuple[np.ndarray, ...]:
    """The four random words, [places] int64 each, of the first places at an iteration, in the layout above. Without a
    view. Shared: do not write to them."""
    return tuple(_block_words(purpose, places, step.seed, step.iteration // _BLOCK)[:, step.iteration % _BLOCK])


@lru_cache(maxsize=16)
def _block_words(purpose: int, places: int, seed: int, block: int) -> np.ndarray:
    """[4, _BLOCK, places]: `host_words` of the iterations from ``block * _BLOCK`` on."""
    place = np.tile(np.arange(places), (_BLOCK, 1))
    iterations = np.arange(block * _BLOCK, (block + 1) * _BLOCK)[:, None] & MASK
    constants = (np.array([value]) for value in (0, purpose, seed >> 32 & MASK))
    return np.stack(philox4x32((place, *constants), (seed & MASK, iterations)))


def exponentials(words: Tensor) -> Tensor:
    """Exp(1) variates -log(u), float32 in [2^-24, 24 log 2], from words of 0 .. 2^32 - 1.

    The logarithm is a fixed sequence of IEEE single-precision operations, each rounded to nearest on its own (no
    fused multiply-add, no library logarithm), so that every device gives the same bits. With ``x`` the word::

        m = float(2 * (x >> 9) + 1)              exact; u = m * 2^-24
        b = bits of m as int32
        k = (b - 0x3f3504f3) >> 23               arithmetic shift; 0 <= k <= 24
        f = float whose bits are b - (k << 23)   m = f * 2^k, sqrt(1/2) <= f < sqrt(2)
        z = f - 1                                exact
        s = z / (f + 1)
        q = s * s
        p = ((C9 * q + C7) * q + C5) * q + C3    each product, then each sum, rounded
        l = 2 * s + s * (q * p)                  log f; sum of two rounded terms (2 * s is exact)
        result = float(24 - k) * LOG_2 - l       product, then difference, rounded

    with C3, C5, C7, C9 the floats nearest to 2/3, 2/5, 2/7, 2/9, and LOG_2 = 0x3f317218. In CUDA: ``__fmul_rn``,
    ``__fadd_rn``, ``__fsub_rn``, ``__fdiv_rn``. Its relative error is below 2e-7 (tested over all 2^23 arguments).
    """
    bits = (((words >> 9) << 1) | 1).to(torch.float32).view(torch.int32)
    exponents = (bits - SQRT_HALF_BITS) >> 23
    f = (bits - (exponents << 23)).view(torch.float32)
    s = (f - 1.0) / (f + 1.0)
    q = s * s
    c3, c5, c7, c9 = LOG_COEFFICIENTS
    p = ((q * c9 + c7) * q + c5) * q + c3  # torch rounds each operation
    tail = s * (q * p)
    return (24 - exponents).to(torch.float32) * LOG_2 - (s + s + tail)
