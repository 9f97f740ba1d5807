"""What was asked for, in a form that can be compared, hashed and written into the manifest."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping, Sequence
from importlib import metadata
from typing import Any

import numpy as np

from data_gen.load import FORMAT
from difflpv.io.tables import ReceiverTable
from difflpv.scene import AreaLight, Camera, DirectionalLight, Scene, SpotLight

__all__ = ["describe_request", "light_entries", "request_digest", "versions"]


def describe_request(
    scene: Scene,
    lit_scenes: Sequence[Scene],
    *,
    receivers: ReceiverTable | int,
    components: Sequence[str],
    spp: int | None,
    target_error: float | None,
    max_spp: int,
    probes: int,
    probe_spp: int,
    camera: Camera | None,
    image_spp: int,
    seed: int,
) -> dict[str, Any]:
    """Everything that decides the bits of the result, as JSON values; ``receivers`` is a table or a count."""
    if isinstance(receivers, ReceiverTable):
        wanted: dict[str, Any] = {"table": _digest(*[receivers.arrays()[k] for k in sorted(receivers.arrays())])}
    else:
        wanted = {"count": receivers}
    sampling = {"spp": spp} if spp is not None else {"target_error": target_error, "max_spp": max_spp}
    image = None
    if camera is not None:
        view = _digest(camera.to_world, np.array([camera.yfov]))
        image = {"camera": view, "width": camera.width, "height": camera.height, "spp": image_spp}
    return {
        "format": FORMAT,
        "scene": {"name": scene.name, "hash": scene.hash},
        "lights": [lit.hash for lit in lit_scenes],
        "receivers": wanted,
        "components": list(components),
        "sampling": sampling,
        "probes": {"count": probes, "spp": probe_spp} if probes else None,
        "images": image,
        "seed": seed,
    }


def request_digest(request: Mapping[str, Any]) -> str:
    """SHA-256 of a request."""
    return hashlib.sha256(json.dumps(request, sort_keys=True).encode()).hexdigest()


def _digest(*arrays: np.ndarray) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype}{array.shape}".encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def versions() -> dict[str, str]:
    """Versions of what computed the targets."""
    packages = {name: metadata.version(name) for name in ("numpy", "scipy", "embreex")}
    try:
        packages["difflpv"] = metadata.version("difflpv")
    except metadata.PackageNotFoundError:
        packages["difflpv"] = "not installed"
    return packages | {"python": platform.python_version()}


def light_entries(scene: Scene) -> list[dict[str, Any]]:
    """A scene's own lights in the form of a light set."""
    entries: list[dict[str, Any]] = []
    for light in scene.lights:
        if isinstance(light, AreaLight):
            entry = {"type": "area", "mesh": light.mesh, "radiance": light.radiance, "one_sided": not light.two_sided}
        elif isinstance(light, DirectionalLight):
            entry = {"type": "directional", "direction": light.direction, "irradiance": light.irradiance}
        elif isinstance(light, SpotLight):
            entry = {"type": "spot", "position": light.position, "direction": light.direction}
            entry |= {"intensity": light.intensity, "inner_angle": light.inner_angle, "outer_angle": light.outer_angle}
        else:
            entry = {"type": "point", "position": light.position, "intensity": light.intensity}
        if not isinstance(light, AreaLight):
            entry["name"] = light.name
        entries.append({k: np.asarray(v).tolist() if isinstance(v, np.ndarray) else v for k, v in entry.items()})
    return entries
