"""Every way of placing probes behind one call."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any, Literal, get_args

from difflpv.placement.task import Placement, PlacementTask, Progress

__all__ = ["PLACEMENT_METHODS", "PlacementMethod", "place"]

PlacementMethod = Literal[
    "grid",
    "grid_moved",
    "spawn_merge",
    "spawn_merge_hierarchical",
    "irradiance_ascent",
    "greedy_removal",
    "gradient",
    "sbplx",
    "crs2",
    "bobyqa",
    "cma",
]

PLACEMENT_METHODS: tuple[PlacementMethod, ...] = get_args(PlacementMethod)
"""Names of all ways of placing."""

_MODULES = {
    "grid": "uniform",
    "grid_moved": "uniform",
    "spawn_merge": "spawn_merge",
    "spawn_merge_hierarchical": "spawn_merge",
    "irradiance_ascent": "irradiance_ascent",
    "greedy_removal": "greedy_removal",
    "gradient": "gradient",
}


def place(
    task: PlacementTask,
    count: int,
    method: PlacementMethod,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    **options: Any,
) -> Placement:
    """Place at most ``count`` probes.

    Args:
        task: what is known.
        count: probes at most.
        method: a name of ``PLACEMENT_METHODS``.
        seed: the same seed gives the same probes.
        progress: told how it goes.
        **options: the method's own; see ``place_<method>`` in the module of its name.

    Returns:
        The placement. Its positions lie in free space and are distinct; its content is the field's if ``radiance`` is None.

    Raises:
        ValueError: an unknown method or option, a count below 1, an option out of range, or no probe in free space.
    """
    if method not in PLACEMENT_METHODS:
        raise ValueError(f"method: expected one of {', '.join(PLACEMENT_METHODS)}, got '{method}'")
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise ValueError(f"count: expected a whole number of probes above 0, got {count!r}")
    function = _function(method)
    parameters = inspect.signature(function).parameters
    known = [name for name in parameters if name not in ("task", "count", "seed", "progress", "solver")]
    for name in options:
        if name not in known:
            raise ValueError(f"{method}: no option '{name}'; its options are {', '.join(known)}")
    return function(task, count, seed=seed, progress=progress, **options)


def _function(method: str) -> Callable[..., Placement]:
    if method in _MODULES:
        function: Callable[..., Placement] = getattr(import_module(f"difflpv.placement.{_MODULES[method]}"), f"place_{method}")
        return function
    return partial(import_module("difflpv.placement.derivative_free").place_derivative_free, solver=method)
