"""``difflpv view``: the scene, its volume and its probes on a page in the browser, or in a PNG."""

from __future__ import annotations

import argparse
import os
import socket
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

from difflpv.cli.options import (
    COMPONENTS,
    LEARNED,
    UsageError,
    add_command,
    add_device,
    add_lights,
    add_output,
    check_indices,
    chosen_light,
    natural,
    positive,
    seeded,
    select_device,
    usage_errors,
)
from difflpv.cli.output import make_folder_of, print_json, warn
from difflpv.cli.solve import add_solve, describe_solve, solve_from

if TYPE_CHECKING:
    from difflpv.scene import Scene
    from difflpv.viewer.probe_view import ProbeView
    from difflpv.viewer.state import Truth

__all__ = ["add_parser", "run"]

_FACETS = 12_000


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = add_command(
        subparsers,
        "view",
        run,
        help="look at scene, volume and probes in a browser, or as a PNG",
        description="Serve a page that shows the scene lit by the volume, a slice of the volume as SH lobes step by step, "
        "probes as shaded spheres, the tetrahedra between them, and receivers coloured by their error; its sliders of lights "
        "and factors solve anew at once. Prints the address, and the ssh command for a machine far away. Ctrl-C ends it. "
        "With --png nothing is served: the same is drawn into a file. The page needs viser (pip install 'difflpv[view]').",
        example="difflpv view cornell --method learned_9x26 --probe-grid 4\n"
        "difflpv view cornell --method learned_9x26 --probe-grid 4 --step 4 --png out/view.png",
    )
    parser.add_argument(
        "--component", nargs="+", choices=COMPONENTS, default=list(COMPONENTS), help="what to add up (default: direct bounce1)"
    )
    shown = parser.add_argument_group("what is shown")
    shown.add_argument("--probes", type=Path, metavar="DIR", help="light probes in the package's own files (probes.json)")
    shown.add_argument(
        "--probe-grid",
        type=positive,
        metavar="N",
        help="probes on a lattice instead, N along the longest edge, lit by the volume",
    )
    shown.add_argument(
        "--targets", type=Path, metavar="DIR", help="targets under whose light set --light errors are coloured (default: none)"
    )
    shown.add_argument("--axis", choices=("x", "y", "z"), default="z", help="normal of the slice (default: %(default)s)")
    shown.add_argument("--height", type=float, metavar="M", help="where the slice cuts the axis [m] (default: the middle)")
    shown.add_argument("--step", type=natural, metavar="K", help="propagation step of the slice (default: the last; PNG: 4)")
    shown.add_argument("--tetrahedra", action="store_true", help="draw the edges of the tetrahedra between probes")
    shown.add_argument(
        "--facets", type=positive, default=_FACETS, metavar="N", help="facets of all surfaces (default: %(default)s)"
    )
    served = parser.add_argument_group("page")
    served.add_argument(
        "--host", default="127.0.0.1", help="address to listen on; 0.0.0.0 for every network (default: %(default)s)"
    )
    served.add_argument(
        "--port", type=natural, default=8080, help="first port to try, the next free one is taken (default: %(default)s)"
    )
    served.add_argument("--png", type=Path, metavar="FILE.png", help="write this picture and serve nothing")
    add_solve(parser, methods=("lpv", "holpv", *LEARNED))
    add_lights(parser)
    add_device(parser)
    seeded(parser)
    add_output(parser)


def run(args: argparse.Namespace) -> int:
    """Solve once, then draw or serve."""
    from difflpv.io import load_scene
    from difflpv.io.atomic import write_bytes
    from difflpv.viewer.look import Look
    from difflpv.viewer.state import AXES, Knobs, ViewState

    if args.png is not None and args.png.suffix.lower() != ".png":
        raise UsageError(f"--png: expected a file name ending in .png, got {args.png}")
    if args.port > 65535:
        raise UsageError(f"--port: expected at most 65535, got {args.port}")
    if args.png is None:
        from difflpv.viewer.page import require_viser

        require_viser()
        _check_host(args)
    scene = load_scene(args.scene)
    solve = solve_from(args, scene)
    lit, truth = _lit(args, scene)
    warn(scene.warnings)
    axis = AXES.index(args.axis)
    low, high, cells = solve.grid.minimum[axis], solve.grid.maximum[axis], solve.grid.resolution[axis]
    height = (low + high) / 2 if args.height is None else args.height
    if not low <= height <= high:
        raise UsageError(f"--height: expected a place within the grid, {low:g}..{high:g} m, got {height:g}")
    index = min(int((height - low) / solve.grid.cell_size), cells - 1)
    last = solve.config.steps
    step = args.step if args.step is not None else last if args.png is None else min(4, last)
    if step > last:
        raise UsageError(f"--step: expected at most the {last} steps of the solve, got {step}")
    probes = _probes(args, scene)
    state = ViewState(
        lit, solve.model(lit), components=list(dict.fromkeys(args.component)), probe_position=probes.position, truth=truth,
        facets=args.facets, seed=args.seed, device=select_device(args.device),
    )  # fmt: skip
    look = Look(
        step=step,
        axis=args.axis,
        index=index,
        probe_light="volume" if probes.content is None else "file",
        tetrahedra=args.tetrahedra,
        errors=truth is not None,
    )
    if args.png is not None:
        from difflpv.viewer.still import draw_still

        make_folder_of("--png", args.png)
        solved = state.solve(Knobs.neutral(lit))
        write_bytes(args.png, draw_still(state, solved, look, probes))
        _tell(args, f"{scene.name}: {describe_solve(solve)}\n-> {args.png}", png=args.png, relative_l2=solved.relative_l2)
        return 0
    return _serve(args, state, probes, look, f"{scene.name}: {describe_solve(solve)}")


def _check_host(args: argparse.Namespace) -> None:
    """A ``UsageError`` for a host that is none of this machine's: the server would wait for it without end."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(args.host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as tried:
            tried.bind(address)
    except (OSError, UnicodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise UsageError(f"--host {args.host}: cannot listen there: {reason}") from None


def _serve(args: argparse.Namespace, state: Any, probes: ProbeView, look: Any, headline: str) -> int:
    from difflpv.viewer.page import Page

    try:
        page = Page(state, probes, host=args.host, port=args.port, look=look)
    except OSError as error:
        raise UsageError(f"--host {args.host} --port {args.port}: cannot listen there: {error.strerror or error}") from None
    try:
        address = f"http://{'localhost' if args.host in ('0.0.0.0', '127.0.0.1') else args.host}:{page.port}"
        inside = "localhost" if args.host == "0.0.0.0" else args.host
        tunnel = f"ssh -L {page.port}:{inside}:{page.port} {os.environ.get('USER', 'user')}@{socket.gethostname()}"
        lines = (f"open {address}", f"from another machine first: {tunnel}", "Ctrl-C ends it")
        _tell(args, "\n  ".join((headline, *lines)), url=address, ssh=tunnel)
        threading.Event().wait()
    except KeyboardInterrupt:  # the way to end it
        return 0
    finally:
        page.close()
    return 0


def _tell(args: argparse.Namespace, text: str, **values: Any) -> None:
    if args.json:
        print_json({"command": "view", "scene": args.scene, **values})
    else:
        print(text, flush=True)


def _lit(args: argparse.Namespace, scene: Scene) -> tuple[Scene, Truth | None]:
    """The scene under its lights, and what is known of them."""
    if args.targets is None:
        return chosen_light(args, scene), None
    import numpy as np

    from data_gen.load import load_targets
    from difflpv.lights import apply_light_set
    from difflpv.viewer.state import Truth

    if args.lights is not None:
        raise UsageError("--lights: with --targets the light set is --light of the targets, not of a file")
    targets = load_targets(args.targets)
    targets.check_scene(scene)
    for component in args.component:
        if component not in targets.components:
            raise UsageError(f"--component: {args.targets} has {', '.join(targets.components)}, not {component}")
    check_indices("--light", [args.light or 0], len(targets.lights), str(args.targets))
    light = targets.lights[args.light or 0]
    irradiance = np.sum([light.irradiance[component] for component in dict.fromkeys(args.component)], axis=0)
    table = targets.receivers
    return apply_light_set(scene, light.entries), Truth(table.position, table.normal, irradiance, light.area_weight)


def _probes(args: argparse.Namespace, scene: Scene) -> ProbeView:
    import numpy as np

    from difflpv.viewer.probe_view import ProbeView, lattice_positions

    if args.probes is not None and args.probe_grid is not None:
        raise UsageError("--probe-grid: --probes already says where the probes are")
    if args.probes is not None:
        from difflpv.cli.probes.judged import check_scene
        from difflpv.probes.probe_files import load_probes

        record = load_probes(args.probes)
        check_scene(args.probes, record, scene)
        return ProbeView.of(record.probes, interpolation=record.reader.interpolation)
    if args.probe_grid is None:
        return ProbeView.of(np.zeros((0, 3)))
    from data_gen.freespace import is_free

    with usage_errors():
        points = lattice_positions(scene, args.probe_grid)
    return ProbeView.of(points[is_free(scene, points)])
