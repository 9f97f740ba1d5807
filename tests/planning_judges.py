"""Judges of ladders whose errors and costs are known, for the planner's tests."""

from difflpv.bench.configuration import Configuration
from difflpv.config import LpvConfig
from difflpv.error_bounds import Estimate


class KnownJudge:
    """Rungs of known error and cost; each level's bounds are wider than the next one's, and always right."""

    slack = (1.2, 1.0, 1.0)
    moving = 0

    def __init__(self, errors, seconds):
        self.errors, self.times, self.judged, self.timed = errors, seconds, [], []

    def work(self, rung):
        return 1e9 * self.times[rung.name]

    def seen(self, rung, level):
        """The error on a level."""
        return self.errors[rung.name]

    def rough(self, rung):
        """A first reading of the time."""
        return self.times[rung.name]

    def judge(self, rung, level):
        self.judged.append((rung.name, level))
        error, width = self.seen(rung, level), (0.2, 0.05, 0.0)[level]
        return Estimate(error, error * (1 - width), error * (1 + width)), self.rough(rung)

    def solve_of(self, rung):
        def solve():
            self.timed.append(rung.name)
            return self.times[rung.name]

        return solve


def rungs_of(count):
    """Rungs that say nothing about one another: each a family of its own."""
    return [Configuration(f"rung {i}", "volume", "learned", LpvConfig(steps=i + 1, l_max=2), cells=None) for i in range(count)]


def sizes_of(cells, **options):
    """One family: the same solve in so many cells."""
    return [Configuration(f"{n}", "volume", "learned", LpvConfig(method="learned_9x26", **options), cells=n) for n in cells]
