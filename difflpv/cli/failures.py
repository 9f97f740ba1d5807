"""Which exceptions are news for the user, in one line, and which are bugs that keep their traceback."""

from __future__ import annotations

import sys
from dataclasses import dataclass

from difflpv.cli.options import UsageError
from difflpv.io.tables import TableError
from difflpv.scene import SceneError

__all__ = ["FAILED", "INTERRUPTED", "Failure", "describe_failure"]

_BAD_INPUT, FAILED, INTERRUPTED = 2, 1, 130  # exit codes
# Looked up by name, so that a command that never loaded torch does not load it to describe its error.
_LAZY = {
    "data_gen.load": ("TargetsError", _BAD_INPUT),
    "data_gen.blocks": ("WorkerError", FAILED),
    "difflpv.io.exr": ("ImageError", _BAD_INPUT),
    "difflpv.config_file": ("ConfigFileError", _BAD_INPUT),
    "difflpv.fitted": ("FittedError", _BAD_INPUT),
    "difflpv.io.exports.convention": ("ExportError", _BAD_INPUT),
    "difflpv.probes.probe_files": ("ProbeFileError", _BAD_INPUT),
    "difflpv.stencil_files": ("StencilError", _BAD_INPUT),
    "difflpv.viewer.page": ("MissingViserError", _BAD_INPUT),
    "difflpv.training.stencils": ("TrainingError", _BAD_INPUT),
    "difflpv.optim.checkpoint": ("CheckpointError", _BAD_INPUT),
}

_NO_MEMORY = ("can't allocate memory", "out of memory", "Failed to allocate")  # torch on the CPU and on CUDA, Warp


@dataclass(frozen=True)
class Failure:
    """What to tell the user, and the exit code."""

    line: str
    code: int


def describe_failure(error: Exception) -> Failure | None:
    """The line and exit code of an expected failure; None for a bug."""
    line = " ".join(str(error).split())
    if isinstance(error, (UsageError, SceneError, TableError)):
        return Failure(line, _BAD_INPUT)
    for module, (name, code) in _LAZY.items():
        if module in sys.modules and isinstance(error, getattr(sys.modules[module], name)):
            return Failure(line, code)
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and any(said in line for said in _NO_MEMORY)):
        return Failure(f"not enough memory: {line.rpartition('Allocator: ')[2] or 'no more to be had'}", FAILED)
    if isinstance(error, FloatingPointError):  # a solve says which value made it overflow
        return Failure(line, FAILED)
    if isinstance(error, OSError) and error.filename is not None:
        return Failure(f"{error.filename}: {error.strerror}", _BAD_INPUT)
    if isinstance(error, FileNotFoundError):
        return Failure(line, _BAD_INPUT)
    return None
