"""Named shares of the light by bounce, and the mean and standard error of each from replicates.

k counts the diffuse reflections between light and receiver: ``direct`` k = 0; ``bounce1`` k = 1 only; ``uptoK``
k = 0..K; ``full`` k = 0..64; ``full_indirect`` k = 1..64.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data_gen.pathtracer import MAX_BOUNCE

__all__ = ["Components", "Estimate", "bounce_range"]


def bounce_range(name: str) -> tuple[int, int]:
    """First and last k of a component.

    Raises:
        ValueError: ``name`` is none of direct, bounce1, upto1..upto64, full, full_indirect.
    """
    fixed = {"direct": (0, 0), "bounce1": (1, 1), "full": (0, MAX_BOUNCE), "full_indirect": (1, MAX_BOUNCE)}
    match = re.fullmatch(r"upto([1-9]\d?)", str(name))
    if name in fixed:
        return fixed[name]
    if match and int(match[1]) <= MAX_BOUNCE:
        return 0, int(match[1])
    raise ValueError(f"component '{name}': expected direct, bounce1, upto1..upto{MAX_BOUNCE}, full or full_indirect")


@dataclass(frozen=True)
class Components:
    """Components asked for together, and the buckets of bounces that they are sums of.

    Attributes:
        names: component names in order, each once.
        bucket_of_bounce: bucket of every k up to the largest one needed, -1 where none needs it.
        membership: 1 where a component contains a bucket, shape [components, buckets].
    """

    names: tuple[str, ...]
    bucket_of_bounce: np.ndarray
    membership: np.ndarray

    @classmethod
    def of(cls, names: Sequence[str]) -> Components:
        """Components by name.

        Raises:
            ValueError: no name, a name twice, or an unknown one.
        """
        if isinstance(names, str) or not len(names) or len(set(names)) != len(names):
            raise ValueError(f"components: expected different names, at least one, got {names!r}")
        ranges = [bounce_range(name) for name in names]
        bounce = np.arange(max(last for _, last in ranges) + 1)
        contains = np.array([(bounce >= first) & (bounce <= last) for first, last in ranges])
        patterns: dict[bytes, int] = {}
        buckets = np.full(len(bounce), -1)
        for k in bounce:
            if contains[:, k].any():
                buckets[k] = patterns.setdefault(contains[:, k].tobytes(), len(patterns))
        membership = np.zeros((len(ranges), len(patterns)))
        for k in bounce[buckets >= 0]:
            membership[:, buckets[k]] = contains[:, k]
        return cls(tuple(names), buckets, membership)

    @property
    def bucket_count(self) -> int:
        """Number of buckets."""
        return self.membership.shape[1]


@dataclass(frozen=True)
class Estimate:
    """Mean of independent replicates and its standard error, arrays of one shape."""

    mean: np.ndarray
    standard_error: np.ndarray

    @classmethod
    def of(cls, replicates: np.ndarray) -> Estimate:
        """Estimate from replicates along the first axis, at least two.

        The spread is taken about the first replicate, so that equal replicates have a standard error of exactly zero.
        """
        count = len(replicates)
        delta = replicates - replicates[0]
        mean = delta.mean(0)
        spread = np.maximum((delta**2).sum(0) - count * mean**2, 0)
        return cls(replicates[0] + mean, np.sqrt(spread / (count * (count - 1))))
