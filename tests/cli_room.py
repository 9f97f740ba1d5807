"""A room in a GLB, light sets for it, and the ``difflpv`` program called in this process."""

import json

import numpy as np
from scene_files import QUAD, Gltf

from difflpv.cli import main

FLOOR = (QUAD * 2 - [1, 1, 0]).astype(np.float32)  # z = 0, normal +z
WALL = FLOOR[:, [0, 2, 1]] + np.float32([0, 1, 1])  # y = 1
LAMP_DOWN = np.array([0, 2, 1, 0, 3, 2], np.uint16)


def room_glb(*, grid_low=(-1.5, -1.5, -0.6), edge=3.2):
    """Floor and wall under a panel that emits downwards, a camera of 16 x 12 pixels, a grid of 8 cells along an edge."""
    gltf = Gltf()
    grey = gltf.material("grey", (0.7, 0.6, 0.5))
    lamp = gltf.material("lamp", (0, 0, 0), (1, 0.75, 0.5), 8.0, doubleSided=False)
    gltf.node(name="floor", mesh=gltf.mesh(gltf.primitive(grey, FLOOR)))
    gltf.node(name="wall", mesh=gltf.mesh(gltf.primitive(grey, WALL)))
    panel = gltf.primitive(lamp, (QUAD * 0.5).astype(np.float32), LAMP_DOWN)
    gltf.node(name="light", mesh=gltf.mesh(panel), translation=[-0.25, -0.25, 1.5])
    gltf.json["cameras"] = [{"type": "perspective", "perspective": {"yfov": 0.9, "znear": 0.1}}]
    gltf.node(name="camera", camera=0, translation=[0.0, 0.0, 4.5])
    high = [low + edge for low in grid_low]
    gltf.json["scenes"][0]["extras"] = {
        "lpv_grid": {"min": list(grid_low), "max": high, "resolution": [8, 8, 8]},
        "image": {"width": 16, "height": 12},
    }
    return gltf.glb()


def write_room(folder, name="room", **options):
    """``room.glb`` and ``sets.json`` with four light sets; the scene's path."""
    (folder / f"{name}.glb").write_bytes(room_glb(**options))
    sets = [[{"type": "area", "mesh": "light", "radiance": [8.0 - k, 6.0, 4.0 + k]}] for k in range(4)]
    (folder / "sets.json").write_text(json.dumps({name: sets}))
    return folder / f"{name}.glb"


def difflpv(*arguments):
    """Exit code of the program, arguments of any type."""
    return main([str(a) for a in arguments])


def make_targets(folder, scene, *arguments):
    """Targets of the room under its four light sets; the folder."""
    out = folder / "targets"
    code = difflpv(
        "targets", scene, "--lights", scene.parent / "sets.json", "--receivers", 40, "--spp", 256,
        "--component", "direct", "bounce1", "--out", out, *arguments,
    )  # fmt: skip
    assert code == 0
    return out
