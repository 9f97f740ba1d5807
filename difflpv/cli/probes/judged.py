"""Probes from folders and what judges them: shared by ``difflpv probes evaluate`` and ``show``. Loads torch when called."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from difflpv.cli.options import UsageError

if TYPE_CHECKING:
    import torch

    from difflpv.placement.held_out import BakedContent, HeldOut
    from difflpv.probes.probe_files import ProbeRecord
    from difflpv.probes.reader import ProbeReader
    from difflpv.scene import Scene

__all__ = ["CONTENTS", "PlacedProbes", "check_scene", "judging"]

# As difflpv.placement.held_out.BAKED_CONTENTS, which would load torch; a test holds the two together.
CONTENTS = ("fitted", "traced")


@dataclass(frozen=True, eq=False)
class PlacedProbes:
    """The valid probes of a folder: their record, positions [n,3] m, and how points read them."""

    folder: Path
    record: ProbeRecord
    position: np.ndarray
    reader: ProbeReader

    @classmethod
    def of(cls, folder: Path, scene: Scene) -> PlacedProbes:
        """Read a folder of probes that were placed in ``scene``.

        Raises:
            ProbeFileError: they cannot be read.
            UsageError: they belong to another scene, or none is valid.
        """
        from difflpv.probes.probe_files import load_probes

        record = load_probes(folder)
        check_scene(folder, record, scene)
        if not len(record.probes.usable):
            raise UsageError(f"{folder}: none of its {len(record.probes)} probes is valid")
        return cls(folder, record, np.array(record.probes.usable.position), record.usable_reader)

    @property
    def seconds(self) -> float | None:
        """What placing took, if the record says so."""
        value = self.record.provenance.get("seconds")
        return float(value) if isinstance(value, (int, float)) and value >= 0 else None

    def content(self, held_out: HeldOut, kind: BakedContent, *, workers: int = 1) -> torch.Tensor:
        """What the probes hold under the judging lights [n,9,C] W/m2."""
        traced = held_out.traced(self.position, workers=workers)
        return traced if kind == "traced" else held_out.fitted(self.position, self.reader, traced)


def judging(scene: Scene, targets: Path, placed_by: Path | None) -> HeldOut:
    """What judges: the targets of a folder, less the lights of those that placed the probes."""
    from data_gen.probe_targets import load_probe_targets
    from difflpv.placement.held_out import HeldOut

    return HeldOut.of(scene, load_probe_targets(targets), None if placed_by is None else load_probe_targets(placed_by))


def check_scene(folder: Path, record: ProbeRecord, scene: Scene) -> None:
    """A ``UsageError`` for probes that were placed in another scene."""
    if record.scene and record.scene["hash"] != scene.hash:
        raise UsageError(f"{folder}: probes of scene '{record.scene['name']}', not of this '{scene.name}'")
