"""Mitsuba 3's path integrator on the receivers of a bench scene.

Receivers are the pixels of a sensor that sends cosine-distributed rays from each, so that a pixel is irradiance. The path
integrator then counts the bounces: depth 2 without the light that is seen at once is the first bounce. Direct light is sampled
by Mitsuba's emitter sampling, which its path integrator would do at the first surface that a camera sees.

An extra (``pip install difflpv[reference]``): without it, or without an LLVM that its compiler can use, ``unavailable`` says
why in one line. LLVM is looked for once, in a child process: one that does not fit ends the process that loads it.
"""

from __future__ import annotations

import glob
import os
import re
import subprocess
import sys
import tempfile
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from difflpv.bench.configuration import Configuration
from difflpv.bench.scenes import BenchScene
from difflpv.scene import AreaLight, DirectionalLight, PointLight, Scene

__all__ = ["FIRST_BOUNCE", "MitsubaRun", "loaded_mitsuba", "unavailable"]

_VARIABLE = "DRJIT_LIBLLVM_PATH"
_PROBE = (
    "import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); import drjit as dr; "
    "mi.render(mi.load_dict(mi.cornell_box()), spp=1); dr.sync_thread(); print('works')"
)
FIRST_BOUNCE: dict[str, Any] = {"max_depth": 2, "rr_depth": 100, "hide_emitters": True}
_OFFSET = 2e-5  # of the scene's extent: rays start so far off a surface
_SEED = 2_000_003  # added to that of the truth


@lru_cache
def unavailable() -> str:
    """Why Mitsuba cannot be used, in one line; empty where it can. Sets the LLVM to be used."""
    if find_spec("mitsuba") is None:
        return "Mitsuba 3 is not installed (pip install 'difflpv[reference]')"

    def version(path: str) -> int:
        found = re.search(r"libLLVM-?(?:\.so\.)?(\d+)", path)
        return int(found[1]) if found else 0

    given = os.environ.get(_VARIABLE)
    places = ("/usr/lib/*/libLLVM*.so*", "/usr/lib64/libLLVM*.so*", "/usr/lib/llvm-*/lib/libLLVM*.so*")
    known = {path for place in places for path in glob.glob(place)}
    candidates = [given] if given else ["", *sorted(known, key=version, reverse=True)[:3]]
    for path in candidates:
        environment = {**os.environ, **({_VARIABLE: path} if path else {})}
        try:
            command = [sys.executable, "-c", _PROBE]
            result = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
        except subprocess.TimeoutExpired:
            continue
        if result.stdout.strip().endswith("works"):
            if path:
                os.environ[_VARIABLE] = path
            return ""
    return f"Mitsuba 3 finds no LLVM that it can use (install libllvm19 or name one in {_VARIABLE})"


@lru_cache
def loaded_mitsuba() -> Any:
    """Mitsuba, its variant set, the receivers' sensor registered.

    Raises:
        ImportError: it cannot be used here.
    """
    why = unavailable()
    if why:
        raise ImportError(why)
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    _define_sensor(mi)
    return mi


def _define_sensor(mi: Any) -> None:
    import drjit as dr

    class Receivers(mi.Sensor):
        """One pixel per receiver: its rays leave by the cosine, weighted so that their mean radiance is irradiance."""

        def place(self, position: np.ndarray, normal: np.ndarray) -> None:
            self._position, self._normal = mi.Point3f(position.T), mi.Normal3f(normal.T)
            self._size = self.film().size()
            dr.eval(self._position, self._normal)

        def sample_ray(self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True) -> Any:
            x = dr.minimum(mi.UInt32(sample2.x * self._size.x), self._size.x - 1)
            y = dr.minimum(mi.UInt32(sample2.y * self._size.y), self._size.y - 1)
            index = dr.minimum(y * self._size.x + x, dr.width(self._position) - 1)
            origin, normal = dr.gather(mi.Point3f, self._position, index), dr.gather(mi.Normal3f, self._normal, index)
            direction = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(sample3))
            return mi.Ray3f(origin, direction), mi.Color3f(dr.pi)

        def sample_ray_differential(self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True) -> Any:
            ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
            return mi.RayDifferential3f(ray), weight

        def sample_direction(self, it: Any, sample: Any, active: Any = True) -> Any:
            """A receiver seen from a point of a surface, for paths that are built from an edge of a light to both sides.

            Mitsuba asks twice for each point and takes both answers for one, as of a pinhole: the point's own bits choose.
            """
            words: list[Any] = [dr.reinterpret_array(mi.UInt32, c) for c in (it.p.x, it.p.y, it.p.z)]
            bits, _ = mi.sample_tea_32(words[0] ^ (words[2] * mi.UInt32(2654435761)), words[1] ^ words[2], 5)
            pixels = int(self._size.x * self._size.y)
            index = mi.UInt32((mi.UInt64(bits) * mi.UInt64(pixels)) >> 32)
            active &= index < dr.width(self._position)
            place = dr.gather(mi.Point3f, self._position, index, active)
            normal = dr.gather(mi.Normal3f, self._normal, index, active)
            way, found = place - it.p, dr.zeros(mi.DirectionSample3f, dr.width(index))
            found.p, found.n, found.dist = place, normal, dr.norm(way)
            found.d = way / found.dist
            found.uv = mi.Point2f(mi.Float(index % self._size.x) + 0.5, mi.Float(index // self._size.x) + 0.5)
            found.pdf, found.delta = dr.select(active, mi.Float(1), mi.Float(0)), True
            weight = dr.maximum(-dr.dot(found.d, normal), 0) / dr.squared_norm(way)
            return found, mi.Color3f(dr.select(active, weight, 0))

        def sample_wavelengths(self, si: Any, sample: Any, active: Any = True) -> Any:
            return [], mi.Color3f(1)

        def needs_aperture_sample(self) -> bool:
            return True

    mi.register_sensor("difflpv_receivers", lambda props: Receivers(props))


class MitsubaRun:
    """Mitsuba's path integrator at so many samples per receiver; the scene is built once."""

    def __init__(self, configuration: Configuration, bench: BenchScene) -> None:
        """Build the scene.

        Raises:
            ImportError: Mitsuba cannot be used here.
            ValueError: a light that has no equal there.
        """
        assert configuration.samples is not None
        self.configuration, self.bench, self.samples = configuration, bench, configuration.samples
        self.setup: dict[str, float] = {}
        self.lights = 0.0
        self._mi = loaded_mitsuba()
        low, high = bench.scene.bounds
        self._lift = _OFFSET * float((high - low).max())
        self.scene = build_scene(self._mi, bench.scene)
        self.integrator = self._mi.load_dict({"type": "path", **FIRST_BOUNCE})
        self._sensors: dict[int, Any] = {}

    def solve(self) -> np.ndarray:
        """Trace every receiver."""
        return self.predict(self.bench.position, self.bench.normal)

    def lookup(self, solved: np.ndarray) -> np.ndarray:
        """What was solved."""
        return solved

    def predict(self, position: np.ndarray, normal: np.ndarray, *, seed: int = 0) -> np.ndarray:
        """Trace other receivers."""
        own = self.bench.seed + _SEED + seed
        if self.bench.component == "direct":
            return self._direct(position, normal, own)
        sensor = self.sensor(position, normal)
        image = self._mi.render(self.scene, sensor=sensor, integrator=self.integrator, spp=self.samples, seed=own)
        return np.array(image).reshape(-1, 3)[: len(position)].astype(float)

    def sensor(self, position: np.ndarray, normal: np.ndarray) -> Any:
        """The receivers as a sensor; kept, as building it is no part of a solve."""
        key = hash((position.shape, position[:1].tobytes(), position[-1:].tobytes()))
        if key not in self._sensors:
            width = min(len(position), 1024)
            film = {
                "type": "hdrfilm", "width": width, "height": -(-len(position) // width), "rfilter": {"type": "box"},
                "pixel_format": "rgb", "component_format": "float32",
            }  # fmt: skip
            sensor = self._mi.load_dict({"type": "difflpv_receivers", "film": film, "sampler": {"type": "independent"}})
            sensor.place((position + self._lift * normal).astype(np.float32), normal.astype(np.float32))
            self._sensors[key] = sensor
        return self._sensors[key]

    def _direct(self, position: np.ndarray, normal: np.ndarray, seed: int) -> np.ndarray:
        import drjit as dr

        mi, count = self._mi, len(position) * self.samples
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed % 2**31, count)
        index = dr.arange(mi.UInt32, count) // self.samples
        lifted = (position + self._lift * normal).astype(np.float32)
        at = dr.zeros(mi.SurfaceInteraction3f, count)
        at.p = dr.gather(mi.Point3f, mi.Point3f(lifted.T), index)
        at.n = dr.gather(mi.Normal3f, mi.Normal3f(normal.T.astype(np.float32)), index)
        at.t = 0.0
        sample, value = self.scene.sample_emitter_direction(at, sampler.next_2d(), True)
        value *= dr.maximum(dr.dot(sample.d, at.n), 0)
        parts = [dr.block_sum(channel, self.samples) / self.samples for channel in (value.x, value.y, value.z)]
        return np.stack([np.array(part) for part in parts], 1).astype(float)


def build_scene(mi: Any, scene: Scene) -> Any:
    """The scene in Mitsuba: meshes with diffuse, two-sided materials, and its lights.

    Raises:
        ValueError: a light that has no equal there.
    """
    content: dict[str, Any] = {"type": "scene"}
    area = {light.mesh: light for light in scene.lights if isinstance(light, AreaLight)}
    with tempfile.TemporaryDirectory() as folder:
        for number, mesh in enumerate(scene.meshes):
            textured = mesh.material.texture is not None and mesh.uv is not None
            own = mi.Mesh(f"mesh{number}", len(mesh.vertices), len(mesh.triangles), has_vertex_texcoords=textured)
            values = mi.traverse(own)
            values["vertex_positions"] = mesh.vertices.astype(np.float32).ravel()
            values["faces"] = mesh.triangles.astype(np.uint32).ravel()
            if textured and mesh.uv is not None:
                values["vertex_texcoords"] = mesh.uv.astype(np.float32).ravel()
            values.update()
            path = Path(folder) / f"{number}.ply"
            own.write_ply(str(path))
            shape: dict[str, Any] = {"type": "ply", "filename": str(path), "face_normals": True}
            shape["bsdf"] = {"type": "twosided", "inner": {"type": "diffuse", "reflectance": _reflectance(mi, mesh.material)}}
            if mesh.name in area:
                if area[mesh.name].two_sided:
                    raise ValueError(f"light '{mesh.name}': Mitsuba has no two-sided area light")
                shape["emitter"] = {"type": "area", "radiance": _rgb(area[mesh.name].radiance)}
            content[f"mesh{number}"] = shape
        for number, light in enumerate(scene.lights):
            if isinstance(light, DirectionalLight):
                content[f"light{number}"] = {
                    "type": "directional", "direction": light.direction.tolist(), "irradiance": _rgb(light.irradiance),
                }  # fmt: skip
            elif isinstance(light, PointLight):
                content[f"light{number}"] = {
                    "type": "point", "position": light.position.tolist(), "intensity": _rgb(light.intensity),
                }  # fmt: skip
            elif not isinstance(light, AreaLight):
                raise ValueError(f"light {number}: a {type(light).__name__} falls off otherwise in Mitsuba")
        return mi.load_dict(content)


def _rgb(value: np.ndarray) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(v) for v in value]}


def _reflectance(mi: Any, material: Any) -> dict[str, Any]:
    if material.texture is None:
        return _rgb(material.albedo)
    image = (material.texture.image * material.albedo).astype(np.float32)[::-1]
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(image)), "raw": True}
