"""Options that commands share: how they are named, read and checked. Knows neither torch nor Warp until asked."""

from __future__ import annotations

import argparse
import math
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from difflpv.scene import Scene

if TYPE_CHECKING:
    import torch

    from difflpv.lights import LightEntry

__all__ = [
    "COMPONENTS",
    "LEARNED",
    "METHODS",
    "UsageError",
    "add_command",
    "add_device",
    "add_lights",
    "add_output",
    "check_indices",
    "chosen_light",
    "fraction",
    "index_list",
    "light_sets",
    "name_list",
    "natural",
    "natural_float",
    "positive",
    "positive_float",
    "seeded",
    "select_device",
    "usage_errors",
]

COMPONENTS = ("direct", "bounce1")
LEARNED = ("learned_4x6", "learned_9x6", "learned_4x26", "learned_9x26", "learned_16x26")
METHODS = ("lpv", "holpv", *LEARNED, "constant", "floor")


class UsageError(ValueError):
    """Options that do not fit: one line."""


@contextmanager
def usage_errors() -> Iterator[None]:
    """Turns the ``ValueError`` of a function that checks options into a ``UsageError``.

    Only around such calls: anywhere else a ``ValueError`` is a bug and keeps its traceback.
    """
    try:
        yield
    except ValueError as error:
        if type(error) is not ValueError:
            raise
        raise UsageError(str(error)) from error


def add_command(subparsers: Any, name: str, run: Any, *, help: str, description: str, example: str) -> Any:
    """A subcommand with SCENE as its first argument."""
    parser = subparsers.add_parser(
        name,
        help=help,
        description=textwrap.fill(description, 100, break_on_hyphens=False),
        epilog=f"example:\n{textwrap.indent(textwrap.dedent(example).strip(), '  ')}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    parser.add_argument(
        "scene", metavar="SCENE", help="a .glb, .gltf, .obj or .ply file, or the name of a bundled scene (cornell, ...)"
    )
    return parser


def add_output(parser: Any) -> None:
    """``--json``."""
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of text, and no progress")


def seeded(parser: Any) -> None:
    """``--seed``."""
    parser.add_argument("--seed", type=natural, default=0, metavar="N", help="of all random numbers (default: %(default)s)")


def add_device(parser: Any) -> None:
    """``--device``."""
    parser.add_argument(
        "--device", default="auto", help="cpu, cuda, cuda:N, or auto: CUDA where there is a GPU (default: %(default)s)"
    )


def add_lights(parser: Any) -> None:
    """``--lights`` and ``--light`` of the commands that work under one light set."""
    group = parser.add_argument_group("lights")
    group.add_argument(
        "--lights", metavar="SETS.json", help="light sets, or 'bundled' for the package's own (default: the scene's lights)"
    )
    group.add_argument("--light", type=natural, metavar="K", help="number of the light set, from 0")


def natural(text: str) -> int:
    """A whole number >= 0."""
    return _whole(text, 0)


def positive(text: str) -> int:
    """A whole number >= 1."""
    return _whole(text, 1)


def _whole(text: str, least: int) -> int:
    if not text.isascii() or not text.isdigit() or len(text) > 15 or int(text) < least:
        raise argparse.ArgumentTypeError(f"expected a whole number >= {least}, got '{text}'")
    return int(text)


def positive_float(text: str) -> float:
    """A finite number above 0."""
    value = _number(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"expected a number above 0, got '{text}'")
    return value


def natural_float(text: str) -> float:
    """A finite number >= 0."""
    value = _number(text)
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"expected a number >= 0, got '{text}'")
    return value


def fraction(text: str) -> float:
    """A number between 0 and 1."""
    value = _number(text)
    if not 0 < value < 1:
        raise argparse.ArgumentTypeError(f"expected a share between 0 and 1, got '{text}'")
    return value


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected a number, got '{text}'") from None


def index_list(text: str) -> tuple[int, ...]:
    """``0-4,7`` -> 0, 1, 2, 3, 4, 7; ``none`` -> nothing."""
    if text == "none":
        return ()
    found: list[int] = []
    for part in text.split(","):
        first, dash, last = part.partition("-")
        numbers = part.isascii() and first.isdigit() and (last.isdigit() if dash else True) and len(part) <= 9
        if not numbers or int(last or first) < int(first):
            raise argparse.ArgumentTypeError(f"expected numbers and ranges such as 0-4,7 (or none), got '{text}'")
        found += range(int(first), int(last or first) + 1)
    if len(set(found)) != len(found):
        raise argparse.ArgumentTypeError(f"expected each number once, got '{text}'")
    return tuple(found)


def name_list(text: str) -> tuple[str, ...]:
    """``a,b`` -> a, b."""
    names = tuple(name.strip() for name in text.split(","))
    if not all(names):
        raise argparse.ArgumentTypeError(f"expected names separated by commas, got '{text}'")
    return names


def check_indices(option: str, chosen: Sequence[int], count: int, source: str) -> None:
    """A ``UsageError`` for a number beyond ``count`` light sets."""
    for index in chosen:
        if index >= count:
            there = "one light set (0)" if count == 1 else f"{count} light sets (0-{count - 1})"
            raise UsageError(f"{option}: {index} is out of range, {source} has {there}")


def light_sets(args: argparse.Namespace, scene: Scene) -> tuple[str, list[list[LightEntry]]] | None:
    """Name and content of ``--lights``; None for the scene's own lights."""
    from difflpv.lights import load_light_sets

    if args.lights is None:
        if args.light is not None:
            raise UsageError("--light: needs --lights SETS.json (or --lights bundled)")
        return None
    bundled = args.lights == "bundled"
    sets = load_light_sets(None if bundled else Path(args.lights), scene.name)
    return ("the bundled file" if bundled else args.lights), sets


def chosen_light(args: argparse.Namespace, scene: Scene) -> Scene:
    """The scene under the one light set that ``--lights`` and ``--light`` name."""
    from difflpv.lights import apply_light_set

    named = light_sets(args, scene)
    if named is None:
        return scene
    source, sets = named
    if args.light is None and len(sets) > 1:
        raise UsageError(f"--lights: choose one of the {len(sets)} light sets with --light 0..{len(sets) - 1}")
    index = args.light or 0
    check_indices("--light", [index], len(sets), source)
    return apply_light_set(scene, sets[index])


def select_device(name: str) -> torch.device:
    """The torch device of ``--device``."""
    import torch

    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    kind, colon, number = name.partition(":")
    if kind not in ("cpu", "cuda") or (colon and not (kind == "cuda" and number.isdigit())):
        raise UsageError(f"--device: expected auto, cpu, cuda or cuda:N, got '{name}'")
    if kind == "cuda" and not torch.cuda.is_available():
        raise UsageError(f"--device: no CUDA device for '{name}' (torch {torch.__version__}); use --device cpu")
    if number and int(number) >= torch.cuda.device_count():
        raise UsageError(f"--device: '{name}' is out of range, there are {torch.cuda.device_count()} CUDA devices")
    return torch.device(name)
