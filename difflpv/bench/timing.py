"""Time of calls that take turns, so that the machine's drift hits all alike; and the memory of one call."""

from __future__ import annotations

import os
import statistics
import sys
import time
import tracemalloc
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import torch

__all__ = ["Timing", "interleaved", "peak_bytes", "timed"]


@dataclass(frozen=True)
class Timing:
    """Repeated runs of one call [s]: the median, the quartiles around it (of fewer than four runs: the extremes)."""

    median: float
    low: float
    high: float
    repeats: int

    @classmethod
    def of(cls, seconds: list[float]) -> Timing:
        """Statistics of at least one run."""
        ordered = sorted(seconds)
        low, high = ordered[0], ordered[-1]
        if len(ordered) >= 4:
            low, _, high = statistics.quantiles(ordered, n=4, method="inclusive")
        return cls(statistics.median(ordered), low, high, len(ordered))

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)

    def __add__(self, other: Timing) -> Timing:
        """One call after the other; the spread is an upper bound."""
        repeats = min(self.repeats, other.repeats)
        return Timing(self.median + other.median, self.low + other.low, self.high + other.high, repeats)


def timed(call: Callable[[], Any]) -> tuple[Any, float]:
    """Result and seconds of one run."""
    begin = time.perf_counter()
    result = call()
    return result, time.perf_counter() - begin


def interleaved(
    calls: Mapping[str, Callable[[], object]],
    repeats: int,
    *,
    device: torch.device | str = "cpu",
    patience: float = 10.0,
    few: Callable[[str], bool] = lambda name: False,
) -> dict[str, Timing]:
    """Time calls in turns, after one round that does not count (kernels compile, caches fill).

    Args:
        calls: by name.
        repeats: rounds.
        device: waited for after each call where it is a CUDA device.
        patience: a call that has taken so many seconds in all is not repeated any more [s].
        few: names that run twice at most.
    """
    times: dict[str, list[float]] = {name: [] for name in calls}
    waits = torch.device(device).type == "cuda"
    for number in range(-1, repeats):
        for name, call in calls.items():
            taken = times[name]
            if (few(name) and number >= 2) or (number > 0 and sum(taken) > patience):
                continue
            begin = time.perf_counter()
            call()
            if waits:
                torch.cuda.synchronize(device)
            if number >= 0:
                taken.append(time.perf_counter() - begin)
    return {name: Timing.of(seconds) for name, seconds in times.items()}


def peak_bytes(call: Callable[[], object]) -> int:
    """Most memory that ``call`` holds at a time beyond what was there before; runs it twice.

    Torch's tensors plus Python's and numpy's objects, each at its own peak. What Embree, Mitsuba and other processes hold is
    not seen. CPU only.
    """
    from torch.profiler import ProfilerActivity, profile

    tracemalloc.start()
    try:
        call()
        objects = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    with _quiet(), profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiler:
        call()
    assert profiler.profiler is not None and profiler.profiler.kineto_results is not None
    events = [e for e in profiler.profiler.kineto_results.events() if e.name() == "[memory]"]
    held = most = 0
    for event in sorted(events, key=lambda e: e.start_ns()):
        held += event.nbytes()
        most = max(most, held)
    return most + objects


@contextmanager
def _quiet() -> Iterator[None]:
    """Torch's profiler writes lines of its own to the standard error, past Python."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
