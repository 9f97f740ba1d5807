"""What an experiment found: readings of each method along a knob, and the limits that follow. Plain JSON both ways."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

__all__ = ["Experiment", "Limit", "Reading", "last_good"]


@dataclass(frozen=True)
class Reading:
    """One method at one setting of the knob. None stands for what was not measured or is not finite.

    Attributes:
        method: name of the method (or solver).
        knob: setting, in the experiment's unit.
        error: the experiment's error, relative L2 of irradiance as a rule.
        gradient: norm of the gradient of the error, with respect to what the experiment names.
        energy: mean irradiance over the true mean.
        message: what the library said, a line each, empty for nothing.
    """

    method: str
    knob: float
    error: float | None = None
    gradient: float | None = None
    energy: float | None = None
    message: str = ""

    def __post_init__(self) -> None:
        for name in ("error", "gradient", "energy"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, float(value) if math.isfinite(value) else None)


@dataclass(frozen=True)
class Limit:
    """How far a method goes.

    Attributes:
        method: name of the method, or "all".
        knob: what was turned.
        limit: where it ends, in words with figures.
        beyond: what happens there.
        detected: what the library does about it.
        cure: what the user can do.
    """

    method: str
    knob: str
    limit: str
    beyond: str
    detected: str
    cure: str


@dataclass(frozen=True)
class Experiment:
    """Result of one experiment.

    Attributes:
        name: of the experiment, as ``--only`` takes it.
        title: a heading.
        knob: what was turned.
        unit: of the knob, empty for none.
        setup: scene, grid, steps and what error and gradient mean, in a sentence or two.
        readings: along the knob, method by method.
        limits: what follows.
        finding: what the readings say, with figures.
        log_knob: the knob's axis is logarithmic.
        error_label: of the error's axis.
        energy_label: of the energy's axis.
        gradient_label: of the gradient's axis.
        categories: names of the settings, where the knob counts them (0, 1, ...).
    """

    name: str
    title: str
    knob: str
    unit: str
    setup: str
    readings: tuple[Reading, ...]
    limits: tuple[Limit, ...]
    finding: str = ""
    log_knob: bool = False
    error_label: str = "relative L2 of irradiance"
    energy_label: str = "mean irradiance / truth"
    gradient_label: str = "|d error / d p|"
    categories: tuple[str, ...] = ()

    @property
    def methods(self) -> list[str]:
        """Names of the methods in order."""
        return list(dict.fromkeys(r.method for r in self.readings))

    def of(self, method: str) -> list[Reading]:
        """Readings of one method."""
        return [r for r in self.readings if r.method == method]

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Experiment:
        """From ``to_json``.

        Raises:
            TypeError, KeyError: it is something else.
        """
        readings = tuple(Reading(**row) for row in values["readings"])
        limits = tuple(Limit(**row) for row in values["limits"])
        return cls(**{**values, "readings": readings, "limits": limits, "categories": tuple(values["categories"])})


def last_good(readings: Sequence[Reading], bad: Callable[[Reading], bool]) -> tuple[Reading | None, Reading | None]:
    """The reading before the first bad one, and that bad one; None where there is none."""
    before = None
    for reading in readings:
        if bad(reading):
            return before, reading
        before = reading
    return before, None
