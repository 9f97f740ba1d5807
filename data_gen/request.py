"""What was asked for, in a form that can be compared, hashed and written into the manifest."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from data_gen.load import FORMAT, KIND, MANIFEST, TargetsError, file_digest, read_manifest
from difflpv.io.atomic import write_json
from difflpv.io.tables import ReceiverTable
from difflpv.lights import apply_light_set
from difflpv.scene import AreaLight, Camera, DirectionalLight, Scene, SpotLight

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

__all__ = [
    "alone_in",
    "check_counts",
    "describe_request",
    "find_finished",
    "finish",
    "light_entries",
    "make_folder",
    "relit",
    "request_digest",
    "versions",
]

_Made = TypeVar("_Made")


def check_counts(*rows: tuple[str, float | None, int, int | None]) -> None:
    """A ``TargetsError`` unless each row's (name, value, least, most or None) value is an integer in range, or None."""
    for name, value, least, most in rows:
        if value is None:
            continue
        if int(value) != value or value < least:
            raise TargetsError(f"{name}: expected an integer >= {least}, got {value}")
        if most is not None and value > most:
            raise TargetsError(f"{name}: expected at most {most}, got {value}")


def relit(
    scene: Scene, light_sets: Sequence[Sequence[Mapping[str, Any]]] | None
) -> tuple[list[list[dict[str, Any]]], tuple[Scene, ...]]:
    """Light sets as plain entries, and the scene under each; None for its own lights."""
    if light_sets is None:
        return [light_entries(scene)], (scene,)
    if not light_sets:
        raise TargetsError("light_sets: expected at least one light set, got none")
    entries = [[dict(entry) for entry in light_set] for light_set in light_sets]
    return entries, tuple(apply_light_set(scene, light_set) for light_set in light_sets)


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


def find_finished(
    out: Path, request: dict[str, Any], overwrite: bool, load: Callable[[Path], _Made], kind: str = KIND
) -> _Made | None:
    """Targets of this request that are there already, by ``load``; None where they have to be made.

    Raises:
        TargetsError: the folder holds targets of another request, or damaged ones, and is not to be overwritten.
    """
    try:
        manifest = read_manifest(out, kind)
        if manifest is None:
            return None
        if manifest["request"] == request:
            return load(out)
    except TargetsError:
        if overwrite:
            return None
        raise
    if overwrite:
        return None
    differing = [key for key in request if manifest["request"].get(key) != request[key]]
    raise TargetsError(
        f"{out}: holds targets of another request (different {', '.join(differing)}); "
        "choose another folder or overwrite them"
    )


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Waits until no other process makes targets in ``folder``: of two runs one makes them, the other finds them.

    The lock ends with the process, however that ends. Where the system or the file system has none, nothing is waited for.
    """
    handle = None
    if fcntl is not None:
        with suppress(OSError):
            handle = os.open(folder, os.O_RDONLY)
            fcntl.flock(handle, fcntl.LOCK_EX)
    try:
        yield
    finally:
        if handle is not None:
            os.close(handle)


def make_folder(out: Path) -> None:
    """The folder for targets; a ``TargetsError`` where it cannot be."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TargetsError(f"{out}: cannot be made: {error.strerror}") from None


def finish(
    out: Path,
    request: dict[str, Any],
    lights: list[dict[str, Any]],
    files: Iterable[Path],
    *,
    rays: int,
    seconds: float,
    kind: str = KIND,
) -> None:
    """Write the manifest, which makes targets finished, and drop their work blocks."""
    manifest = {
        "kind": kind,
        "format": FORMAT,
        "request": request,
        "lights": lights,
        "rays": rays,
        "seconds": round(seconds, 3),
        "versions": versions(),
        "files": {path.name: file_digest(path) for path in files},
    }
    write_json(out / MANIFEST, manifest)
    for folder in out.glob(".blocks-*"):  # also those of an abandoned request: this folder is taken now
        shutil.rmtree(folder, ignore_errors=True)


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
