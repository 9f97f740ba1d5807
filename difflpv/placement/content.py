"""What placed probes hold: the field's values or content fitted to the points, its error, and its way into a file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from difflpv.placement.reconstruction import fitted_content, relative_error
from difflpv.placement.task import Placement, PlacementTask
from difflpv.probes.probe_files import ProbeRecord
from difflpv.probes.probe_set import ProbeSet
from difflpv.probes.rows import Rows

__all__ = ["held_content", "probe_record", "training_error", "with_fitted_content"]

_KEPT = 200  # rows of a history that a file keeps


def held_content(task: PlacementTask, placement: Placement) -> torch.Tensor:
    """Radiance SH of the probes for each light of the task [n,9,C] W/m2: their own, else the field's where they are."""
    if placement.radiance is not None:
        return torch.as_tensor(placement.radiance)
    with torch.no_grad():
        return task.field(torch.as_tensor(placement.position))


def with_fitted_content(task: PlacementTask, placement: Placement) -> Placement:
    """The placement with content fitted to the task's points as they read it (``fitted_content``)."""
    with torch.no_grad():
        content = fitted_content(task, torch.as_tensor(placement.position), _rows(task, placement))
    return replace(placement, radiance=content.numpy())


def training_error(task: PlacementTask, placement: Placement) -> float:
    """Relative L2 error of irradiance over 26 normals at the task's points, with what the probes hold."""
    with torch.no_grad():
        return float(relative_error(task, _rows(task, placement).apply(held_content(task, placement))))


def probe_record(
    task: PlacementTask, placement: Placement, *, light: int = 0, provenance: Mapping[str, Any] | None = None
) -> ProbeRecord:
    """A placement as probes for ``save_probes``, which hold the light of one set.

    Args:
        task: which the probes were placed for.
        placement: the probes.
        light: number of the light set, in the order of the task's channels, whose content the probes hold.
        provenance: further JSON values beside seconds, evaluations and the history (at most 200 rows of step, training error
            and number of probes; an error that is not known is null).

    Raises:
        ValueError: a light set that the task has not.
    """
    lights = task.radiance.shape[2] // 3
    if not 0 <= light < lights:
        raise ValueError(f"light: expected a number from 0 to {lights - 1}, got {light}")
    content = held_content(task, placement)[:, :, 3 * light : 3 * light + 3].numpy()
    spent = {
        "seconds": placement.seconds,
        "evaluations": int(placement.evaluations),
        "history": _thinned(placement.history),
    }
    return ProbeRecord(
        ProbeSet(placement.position, content),
        {"name": task.scene.name, "hash": task.scene.hash},
        placement.method,
        {"training": training_error(task, placement)},
        {**(provenance or {}), **spent},
        reader=placement.reader,
    )


def _rows(task: PlacementTask, placement: Placement) -> Rows:
    """Of the task's points."""
    reader = placement.reader.over(placement.position, task.scene, raycaster=task.raycaster)
    return reader.rows(torch.as_tensor(placement.position), task.points)


def _thinned(history: tuple[tuple[int, float, int], ...]) -> list[list[float | int | None]]:
    chosen = np.unique(np.linspace(0, len(history) - 1, min(len(history), _KEPT)).round().astype(int))
    rows = [history[k] for k in chosen]
    return [[int(step), float(error) if math.isfinite(error) else None, int(count)] for step, error, count in rows]
