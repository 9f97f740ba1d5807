"""A solve's configuration and cells as a JSON file, for ``--config`` and for Python.

    {"method": "learned_9x6", "cells": 24, "config": {"method": "learned_9x6", "steps": 24, ...}, ...}

``difflpv plan`` writes such files; what else stands beside these three is for people, but for the scene that light probes of
the configuration were placed in ("scene", "scene_hash"). The object of ``LpvConfig.to_json`` alone will do too: the scene's
own cells are meant then.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from difflpv.config import LpvConfig

__all__ = ["ConfigFile", "ConfigFileError", "read_config_file"]


class ConfigFileError(ValueError):
    """A configuration file that is missing, damaged or not one: one line."""


@dataclass(frozen=True)
class ConfigFile:
    """What a configuration file holds.

    Attributes:
        method: of ``config``, or "constant".
        config: of the volume; None for "constant".
        cells: along x of the scene's grid; None for the scene's own.
        scene: name and hash of the scene that the configuration's light probes were placed in; None where it is not told.
    """

    method: str
    config: LpvConfig | None
    cells: int | None
    scene: tuple[str, str] | None = None


def read_config_file(path: str | Path) -> ConfigFile:
    """Read a configuration file.

    Raises:
        ConfigFileError: naming the file and what is wrong with it.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigFileError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise ConfigFileError(f"{path}: JSON is damaged: {' '.join(str(error).split())}") from None
    if not isinstance(content, dict):
        raise ConfigFileError(f"{path}: expected an object, got {type(content).__name__}")
    values, cells = content.get("config", None if "cells" in content else content), content.get("cells")
    if cells is not None and (isinstance(cells, bool) or not isinstance(cells, int) or cells < 3):
        raise ConfigFileError(f"{path}: cells: expected an integer >= 3, got {cells!r}")
    if values is None and content.get("method") == "constant":
        return ConfigFile("constant", None, cells)
    if not isinstance(values, dict) or "method" not in values:
        raise ConfigFileError(f"{path}: config: expected an object with a 'method', as 'difflpv plan' writes it")
    try:
        config = LpvConfig.from_json(values)
    except (TypeError, ValueError) as error:
        raise ConfigFileError(f"{path}: config: {' '.join(str(error).split())}") from None
    placed = (content.get("scene"), content.get("scene_hash"))
    scene = (placed[0], placed[1]) if isinstance(placed[0], str) and isinstance(placed[1], str) else None
    return ConfigFile(config.method, config, cells, scene)
