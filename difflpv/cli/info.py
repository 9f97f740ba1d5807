"""``difflpv info``: what a scene file holds."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

import numpy as np

from difflpv.cli.options import add_command, add_output
from difflpv.cli.output import print_json, warn

if TYPE_CHECKING:
    from difflpv.scene import Camera, Light, Mesh, Scene

__all__ = ["add_parser", "run"]

_UNITS = {"radiance": "W/(m2 sr)", "intensity": "W/sr", "irradiance": "W/m2"}
_ROWS = 40  # meshes listed in the text; --json has them all


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = add_command(
        subparsers,
        "info",
        run,
        help="what a scene file holds",
        description="Meshes, triangles, materials, lights, cameras and the grid of a scene, with everything that loading "
        "it had to warn about.",
        example="difflpv info cornell\ndifflpv info room.glb --json",
    )
    add_output(parser)


def run(args: argparse.Namespace) -> int:
    """Print it."""
    from difflpv.config import grid_for
    from difflpv.io import load_scene

    scene = load_scene(args.scene)
    grid = grid_for(scene)
    warnings = list(scene.warnings)
    low, high = scene.bounds
    if (np.asarray(grid.minimum) > low + 1e-6).any() or (np.asarray(grid.maximum) < high - 1e-6).any():
        warnings.append(
            f"the grid {_vector(grid.minimum)} .. {_vector(grid.maximum)} m does not contain the scene "
            f"{_vector(low)} .. {_vector(high)} m: VPLs outside it are lost"
        )
    warn(warnings)
    content = {
        "command": "info",
        "scene": scene.name,
        "hash": scene.hash,
        "triangles": len(scene.triangle_mesh),
        "surface_area": float(scene.triangle_areas.sum()),
        "bounds": [low, high],
        "meshes": [_mesh(scene, k) for k in range(len(scene.meshes))],
        "materials": _materials(scene),
        "lights": [_light(light) for light in scene.lights],
        "cameras": [_camera(camera) for camera in scene.cameras],
        "grid": {
            "from_file": scene.grid is not None,
            "minimum": grid.minimum,
            "maximum": grid.maximum,
            "cell_size": grid.cell_size,
            "resolution": grid.resolution,
        },
        "warnings": warnings,
    }
    if args.json:
        print_json(content)
    else:
        print(_text(scene, content))
    return 0


def _mesh(scene: Scene, index: int) -> dict[str, Any]:
    mesh: Mesh = scene.meshes[index]
    area = float(scene.triangle_areas[scene.triangle_mesh == index].sum())
    return {"name": mesh.name, "triangles": len(mesh.triangles), "area": area, "material": mesh.material.name}


def _materials(scene: Scene) -> list[dict[str, Any]]:
    found = {id(mesh.material): mesh.material for mesh in scene.meshes}
    return [
        {
            "name": material.name,
            "albedo": material.albedo,
            "texture": None if material.texture is None else list(material.texture.image.shape[1::-1]),
            "emission": material.emission,
        }
        for material in found.values()
    ]


def _light(light: Light) -> dict[str, Any]:
    kind = type(light).__name__.removesuffix("Light").lower()
    values = {k: v for k, v in vars(light).items() if k not in ("name", "mesh")}
    return {"type": kind, "name": getattr(light, "name", None) or getattr(light, "mesh", "")} | values


def _camera(camera: Camera) -> dict[str, Any]:
    degrees = float(np.degrees(camera.yfov))
    return {"position": camera.to_world[:3, 3], "yfov": degrees, "width": camera.width, "height": camera.height}


def _vector(values: Any) -> str:
    return "(" + ", ".join(f"{float(v):.4g}" for v in values) + ")"


def _text(scene: Scene, content: dict[str, Any]) -> str:
    lines = [
        f"scene      {scene.name}: {len(scene.meshes)} meshes, {content['triangles']} triangles, "
        f"{content['surface_area']:.4g} m2",
        f"bounds     {_vector(content['bounds'][0])} .. {_vector(content['bounds'][1])} m",
    ]
    for mesh in content["meshes"][:_ROWS]:
        lines.append(f"mesh       {mesh['name']}: {mesh['triangles']} triangles, {mesh['area']:.4g} m2, {mesh['material']}")
    if len(content["meshes"]) > _ROWS:
        lines.append(f"mesh       ... and {len(content['meshes']) - _ROWS} more (--json lists them all)")
    for material in content["materials"]:
        texture = "" if material["texture"] is None else " x texture {} x {}".format(*material["texture"])
        shines = f", emits {_vector(material['emission'])} W/(m2 sr)" if np.any(material["emission"]) else ""
        lines.append(f"material   {material['name']}: albedo {_vector(material['albedo'])}{texture}{shines}")
    for light in content["lights"]:
        power = next(name for name in _UNITS if name in light)
        where = f" at {_vector(light['position'])} m" if "position" in light else ""
        along = f" along {_vector(light['direction'])}" if "direction" in light else ""
        line = f"light      {light['type']} '{light['name']}'{where}{along}: {power} {_vector(light[power])} {_UNITS[power]}"
        lines.append(line + (", both sides" if light.get("two_sided") else ""))
    for camera in content["cameras"]:
        size = f"{camera['width']} x {camera['height']} pixels"
        lines.append(f"camera     at {_vector(camera['position'])} m, {camera['yfov']:.3g} degrees high, {size}")
    grid = content["grid"]
    cells = " x ".join(str(n) for n in grid["resolution"])
    source = "from the file" if grid["from_file"] else "a cube around the scene: the file names none"
    box = f"{_vector(grid['minimum'])} .. {_vector(grid['maximum'])} m"
    lines.append(f"grid       {cells} cells of {grid['cell_size']:.4g} m, {box} ({source})")
    return "\n".join(lines)
