"""An OpenEXR atlas with one latitude-longitude map for each probe, and JSON beside it that says which is where.

Direction of column x and row y of a tile of W = 2H by H pixels, at pixel centres: longitude = pi - 2 pi (x + 1/2) / W, latitude
= pi/2 - pi (y + 1/2) / H, direction = (sin lon cos lat, sin lat, cos lon cos lat): the top is +y, the middle +z, +x a quarter
to its left, as seen from inside. Source: OpenEXR, ImfEnvmap.h (ENVMAP_LATLONG), whose axes these are.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Literal

import numpy as np

from difflpv.io.atomic import write_json
from difflpv.io.exports.convention import (
    ENGINE_READS,
    ExportError,
    check_file,
    check_own,
    convention_record,
    rounded,
    usable_probes,
)
from difflpv.io.exr import write_exr
from difflpv.probes.probe_files import ProbeRecord
from difflpv.probes.probe_set import irradiance_of
from difflpv.sh import sh_basis

__all__ = ["export_exr", "tile_directions"]

_SOURCES = ("https://github.com/AcademySoftwareFoundation/openexr/blob/main/src/lib/OpenEXR/ImfEnvmap.h",)
_MAX_VALUES = 2**27  # what difflpv.io.exr reads back


def tile_directions(height: int) -> np.ndarray:
    """Unit directions [height, 2 height, 3] of the pixel centres of a tile."""
    longitude = math.pi - math.pi * (np.arange(2 * height) + 0.5) / height
    latitude = math.pi / 2 - math.pi * (np.arange(height) + 0.5) / height
    lon, lat = np.meshgrid(longitude, latitude)
    return np.stack([np.sin(lon) * np.cos(lat), np.sin(lat), np.cos(lon) * np.cos(lat)], -1)


def export_exr(
    record: ProbeRecord, out: Path, *, quantity: Literal["irradiance", "radiance"] = "irradiance", height: int = 16
) -> list[Path]:
    """Write the atlas ``.exr``, and JSON of the same name.

    Args:
        record: the probes.
        out: the image.
        quantity: irradiance E(n) [W/m2] by normal, or radiance L(w) [W/(m2 sr)] by direction; both may be negative where the
            series of degree 2 rings.
        height: rows of one map; it is twice as wide.
    """
    check_file(out, ".exr")
    described = check_own(out.with_suffix(".json"))
    if quantity not in ("irradiance", "radiance"):
        raise ValueError(f"quantity: expected irradiance or radiance, got {quantity!r}")
    if not 2 <= height <= 1024:
        raise ExportError(f"height: expected 2 to 1024 rows a probe, got {height}")
    probes = usable_probes(record)
    columns = math.ceil(math.sqrt(len(probes) / 2))
    rows = math.ceil(len(probes) / columns)
    if rows * columns * 2 * height * height * 3 > _MAX_VALUES:
        raise ExportError(f"{out}: {len(probes)} maps of {height} rows are more than {_MAX_VALUES} values; lower the height")
    directions = tile_directions(height).reshape(-1, 3)
    rounded(probes.radiance)  # refuses what float32 cannot hold
    irradiance = quantity == "irradiance"
    tiles = irradiance_of(probes.radiance, directions) if irradiance else sh_basis(directions, 2) @ probes.radiance
    maps = np.zeros((rows * columns, height, 2 * height, 3))
    maps[: len(probes)] = np.reshape(tiles, (-1, height, 2 * height, 3))
    atlas = maps.reshape(rows, columns, height, 2 * height, 3).swapaxes(1, 2).reshape(rows * height, -1, 3)
    convention = convention_record(
        record,
        "OpenEXR atlas of latitude-longitude maps",
        quantity="irradiance E(n) [W/m2] by normal" if irradiance else "radiance L(w) [W/(m2 sr)] by direction",
        evaluate="column x, row y of a tile W by H: longitude = pi - 2 pi (x + 1/2) / W, latitude = pi/2 - pi (y + 1/2) / H, "
        "direction = (sin lon cos lat, sin lat, cos lon cos lat)",
        axes="right-handed, y up",
        sources=_SOURCES,
        reads=ENGINE_READS["exr"],
        scale=1.0,
        layout="tile k of width W, height H at column (k mod columns), row (k div columns), from the top left; no gutter",
        tile=[2 * height, height],
        columns=columns,
    )
    channels = {name: atlas[:, :, k] for k, name in enumerate("RGB")}
    write_exr(out, channels, {"difflpv:convention": json.dumps(convention)})
    write_json(described, {"convention": convention, "positions": rounded(probes.position)})
    return [out, described]
