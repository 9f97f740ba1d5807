"""Random numbers that are addressed, not consumed: equal bits for any number of workers and after any resume.

Every work block owns one stream ``SampleStream(seed, *address, round=...)``. The first dimensions of its paths are
randomised quasi-Monte Carlo: one Sobol' sequence, digitally shifted by a random word per replicate and dimension, so
that each replicate is an unbiased estimate of its own and independent of the others; the standard error comes from
them. Rounds of samples go on along the sequence under the same shifts, which halves the variance against fresh points
(measured: Cornell box, first bounce, 4,096 paths). Further dimensions are Philox numbers.

Sources: Salmon et al. 2011 (Philox); Joe and Kuo 2008, file new-joe-kuo-6 (Sobol' directions); Lemieux, Monte Carlo and
Quasi-Monte Carlo Sampling, 2009, section 6.2.2 (digital shift).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

__all__ = ["MAX_SAMPLES", "SOBOL_DIMENSIONS", "SampleStream", "generator", "sobol_words"]

SOBOL_DIMENSIONS = 16
MAX_SAMPLES = 2**16
# (degree s, coefficients a, initial m_1..m_s) of dimensions 2 to 16; scipy has them, but takes a second to import
_PRIMITIVE: tuple[tuple[int, int, tuple[int, ...]], ...] = (
    (1, 0, (1,)),
    (2, 1, (1, 3)),
    (3, 1, (1, 3, 1)),
    (3, 2, (1, 1, 1)),
    (4, 1, (1, 1, 3, 3)),
    (4, 4, (1, 3, 5, 13)),
    (5, 2, (1, 1, 5, 5, 17)),
    (5, 4, (1, 1, 5, 5, 5)),
    (5, 7, (1, 1, 7, 11, 19)),
    (5, 11, (1, 1, 5, 1, 1)),
    (5, 13, (1, 1, 1, 3, 11)),
    (5, 14, (1, 3, 5, 5, 31)),
    (6, 1, (1, 3, 3, 9, 7, 49)),
    (6, 13, (1, 1, 1, 15, 21, 21)),
    (6, 16, (1, 3, 1, 13, 27, 49)),
)


def generator(seed: int, *address: int) -> np.random.Generator:
    """Philox generator of the stream ``(seed, *address)``, all non-negative integers."""
    if seed < 0:
        raise ValueError(f"seed: expected an integer >= 0, got {seed}")
    sequence = np.random.SeedSequence(int(seed), spawn_key=tuple(int(part) for part in address))
    return np.random.Generator(np.random.Philox(sequence))


def _direction_integers(degree: int, coefficients: int, initial: tuple[int, ...], count: int) -> list[int]:
    """Joe and Kuo's recurrence for m_1..m_count."""
    m = list(initial)
    while len(m) < count:
        value = m[-degree] ^ (m[-degree] << degree)
        for k in range(1, degree):
            value ^= (coefficients >> (degree - 1 - k) & 1) * m[-k] << k
        m.append(value)
    return m[:count]


@lru_cache(maxsize=8)
def sobol_words(first: int, count: int) -> np.ndarray:
    """Sobol' points ``first`` to ``first + count`` as 32-bit fractions, shape [SOBOL_DIMENSIONS, count] uint32.

    Raises:
        ValueError: the range is empty or leaves the first ``MAX_SAMPLES`` points.
    """
    if first < 0 or count < 1 or first + count > MAX_SAMPLES:
        raise ValueError(f"samples: expected a range within {MAX_SAMPLES} points, got {first}..{first + count}")
    bits = MAX_SAMPLES.bit_length() - 1
    index = np.arange(first, first + count)
    words = np.zeros((SOBOL_DIMENSIONS, count), np.uint32)
    for dimension in range(SOBOL_DIMENSIONS):
        integers = [1] * bits if dimension == 0 else _direction_integers(*_PRIMITIVE[dimension - 1], bits)
        for bit, integer in enumerate(integers):
            words[dimension] ^= np.where(index >> bit & 1, np.uint32(integer << (31 - bit)), np.uint32(0))
    return words


class SampleStream:
    """Uniform numbers for ``groups`` x ``samples`` paths; path ``g * samples + i`` is sample i of replicate g.

    Args:
        seed: seed of the whole run.
        address: further integers that name the entities.
        groups: number of independent replicates (all entities together).
        samples: samples per replicate in this round.
        round: which part of each replicate's sequence: samples ``round * samples`` to ``(round + 1) * samples``.
    """

    def __init__(self, seed: int, *address: int, groups: int, samples: int, round: int = 0) -> None:
        self.samples = samples
        self.path_count = groups * samples
        self._points = sobol_words(round * samples, samples)
        self._shifts = generator(seed, *address).integers(0, 2**32, (SOBOL_DIMENSIONS, groups), np.uint32)
        self._rng = generator(seed, *address, round + 1)

    def uniform(self, dimension: int, count: int, paths: np.ndarray | None = None) -> np.ndarray:
        """Numbers in [0, 1) of ``count`` dimensions from ``dimension`` on, shape [count, n] float32.

        Args:
            dimension: first dimension; from ``SOBOL_DIMENSIONS`` on the numbers are independent Philox ones.
            count: how many dimensions.
            paths: path indices [n]; all paths in order if None.
        """
        n = self.path_count if paths is None else len(paths)
        if dimension + count > SOBOL_DIMENSIONS:
            return self._rng.random((count, n), np.float32)
        rows = slice(dimension, dimension + count)
        if paths is None:
            words = (self._points[rows, None, :] ^ self._shifts[rows, :, None]).reshape(count, n)
        else:
            words = self._points[rows].take(paths % self.samples, 1) ^ self._shifts[rows].take(paths // self.samples, 1)
        # 24 bits: the largest value stays below 1 in float32
        return (words >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24)

    def independent(self, n: int) -> np.ndarray:
        """``n`` independent Philox numbers in [0, 1), float32."""
        return self._rng.random(n, np.float32)
