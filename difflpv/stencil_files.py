"""Linear stencils on disk, and the shipped ones by name.

``<name>.safetensors`` holds ``offsets`` [n,3], ``matrices`` [n,K,K] and, optionally, ``lookup_gains`` [l_max+1].
"""

from __future__ import annotations

import warnings
from functools import lru_cache
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from difflpv.io.atomic import atomic_path
from difflpv.stability import stability
from difflpv.stencil import LinearStencil

__all__ = ["LEARNED_STENCILS", "StencilError", "learned_stencil", "load_stencil", "save_stencil"]

LEARNED_STENCILS = ("learned_4x6", "learned_9x6", "learned_4x26", "learned_9x26", "learned_16x26")
_FOLDER = Path(__file__).parent / "data" / "stencils"


class StencilError(ValueError):
    """A stencil file that cannot be used: one line naming file and reason."""


def save_stencil(path: str | Path, stencil: LinearStencil) -> None:
    """Write ``offsets`` int32, ``matrices`` (destination from source coefficients) and ``lookup_gains`` float64, atomically."""
    tensors: dict[str, np.ndarray] = {
        "offsets": np.ascontiguousarray(stencil.offsets, dtype=np.int32),
        "matrices": np.ascontiguousarray(stencil.matrices, dtype=np.float64),
        "lookup_gains": np.array(stencil.lookup_gains, dtype=np.float64),
    }
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as target:
        save_file(tensors, target, metadata={"name": stencil.name})


def load_stencil(path: str | Path) -> LinearStencil:
    """Read a stencil; its name is the file's. One that lets light grow loads with a ``RuntimeWarning`` that says so.

    Raises:
        StencilError: missing or damaged file, or numbers that are no stencil.
    """
    stencil = _read(Path(path))
    report = stability(stencil)
    if not report.stable:
        warnings.warn(report.advice, RuntimeWarning, stacklevel=2)
    return stencil


def _read(path: Path) -> LinearStencil:
    try:
        tensors = load_file(path)
    except FileNotFoundError:
        raise StencilError(f"{path}: not found: expected a stencil file (.safetensors)") from None
    except (OSError, SafetensorError) as error:
        raise StencilError(f"{path}: damaged: {' '.join(str(error).split())}") from None
    missing = {"offsets", "matrices"} - set(tensors)
    if missing:
        raise StencilError(f"{path}: expected tensors 'offsets' and 'matrices', missing {', '.join(sorted(missing))}")
    try:
        offsets = tensors["offsets"].astype(np.int64)
        gains = tuple(tensors.get("lookup_gains", np.empty(0)).tolist())
        return LinearStencil(path.stem, offsets, tensors["matrices"].astype(np.float64), gains)
    except (TypeError, ValueError) as error:
        raise StencilError(f"{path}: {' '.join(str(error).split())}") from None


@lru_cache
def learned_stencil(name: str) -> LinearStencil:
    """A shipped learned stencil, e.g. ``"learned_9x26"``: 9 coefficients, 26 neighbours and the cell itself.

    Raises:
        StencilError: no such stencil, naming those that there are.
    """
    if name not in LEARNED_STENCILS:
        raise StencilError(f"stencil: expected one of {', '.join(LEARNED_STENCILS)}, got {name!r}")
    return _read(_FOLDER / f"{name}.safetensors")
