"""Files: scenes in, tables and images in and out. One module per format, each the only importer of its library."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from difflpv.scene import Scene, SceneError

__all__ = ["SCENE_SUFFIXES", "bundled_scenes", "load_scene"]

SCENE_SUFFIXES = (".glb", ".gltf", ".obj", ".ply")


def _bundled_folder() -> Path:
    return Path(str(resources.files("difflpv"))) / "data" / "scenes"


def bundled_scenes() -> list[str]:
    """Names of the scenes that come with the package, sorted."""
    return sorted(path.stem for path in _bundled_folder().glob("*.glb"))


def load_scene(source: str | Path) -> Scene:
    """Load a scene file, or a bundled scene by its name.

    Args:
        source: path of a ``.glb``, ``.gltf``, ``.obj`` (with its MTL) or ``.ply`` file, or a name of
            ``bundled_scenes()`` such as ``"cornell"``.

    Returns:
        The scene in world space: metres, linear RGB, radiometric units. ``Scene.warnings`` tells what was dropped.

    Raises:
        SceneError: one line that names the file, the element and the reason.
    """
    text = str(source)
    path = Path(text)
    if path.suffix.lower() not in SCENE_SUFFIXES:
        if text in bundled_scenes():
            path = _bundled_folder() / f"{text}.glb"
        elif path.is_dir():
            expected = f"a scene file ({', '.join(SCENE_SUFFIXES)}) or a bundled name"
            raise SceneError(f"{path}: expected {expected}, got a folder")
        elif not path.suffix and not path.exists():
            raise SceneError(f"scene '{text}': no such bundled scene, there are {', '.join(bundled_scenes())}")
        else:
            raise SceneError(f"{text}: unknown scene format '{path.suffix}', expected {', '.join(SCENE_SUFFIXES)}")
    if not path.is_file():
        raise SceneError(f"{path}: {'expected a file, got a folder' if path.is_dir() else 'no such file'}")
    try:
        return _load(path)
    except SceneError as error:
        raise SceneError(f"{path}: {_one_line(error)}") from None
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror or _one_line(error)}") from None
    except RecursionError:
        raise SceneError(f"{path}: nested too deeply") from None


def _load(path: Path) -> Scene:
    # Imported on demand: a worker that loads a GLB does not wait for trimesh.
    suffix = path.suffix.lower()
    if suffix == ".obj":
        from difflpv.io.obj import load_obj

        return load_obj(path)
    if suffix == ".ply":
        from difflpv.io.ply import load_ply

        return load_ply(path)
    from difflpv.io.gltf import load_gltf

    return load_gltf(path)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
