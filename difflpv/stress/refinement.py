"""Cells that shrink and cells that are too large: refinement, rooms smaller than a cell, thin walls, a door."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from difflpv.grid import Grid
from difflpv.illumination import Component
from difflpv.leakage import dark_receivers
from difflpv.pipeline import Lpv
from difflpv.scene import Scene
from difflpv.simulate import solve_irradiance
from difflpv.stress.measure import Bench, Lit, read
from difflpv.stress.results import Experiment, Limit, Reading, last_good
from difflpv.stress.scenes import Case, bundled_case, room_scene, traced_case, walled_rooms

__all__ = ["door", "refinement", "refinement_direct", "rooms", "walls"]

_CELLS_PER_ROOM = (12, 8, 4, 2, 1.6, 1.4, 1.01, 0.5, 0.25)
_WALLS_IN_CELLS = (0.1, 0.25, 0.5, 0.9, 0.99, 1.01, 1.5, 2.0, 3.0)


def refinement(bench: Bench) -> Experiment:
    """The same scene in ever smaller cells, one bounce."""
    return _refinement(bench, "refinement", "bounce1", "one bounce")


def refinement_direct(bench: Bench) -> Experiment:
    """The same scene in ever smaller cells, direct light of a panel."""
    return _refinement(bench, "refinement_direct", "direct", "direct light of its panel")


def _refinement(bench: Bench, name: str, component: Component, what: str) -> Experiment:
    case = bundled_case("cornell", bench.settings, bench.folder)
    readings, limits = [], []
    for method, config in bench.methods.items():
        own = []
        for cells in bench.settings.refinement:
            grid = case.grid.with_cells(cells)
            surface, lamp = _enough_samples(case, grid)
            lit = Lit.of(
                case,
                config,
                component,
                grid=grid,
                seed=bench.settings.seed,
                surface_samples=surface,
                area_samples=lamp,
            )
            by = "propagation" if cells <= bench.settings.gradient_cells else None
            own.append(read(method, cells, lit, replace(config, steps=cells), by=by))
        readings += own
        limits.append(_refined(method, own))
    first, last = bench.settings.refinement[0], bench.settings.refinement[-1]
    worse = [limit.method for limit in limits if "gets worse" in limit.limit]
    steady = [limit.method for limit in limits if limit.method not in worse]
    finding = (
        f"From {first}³ to {last}³ cells, worse: {', '.join(worse) or 'none'}; no worse: {', '.join(steady) or 'none'}. A "
        "published kernel diffuses: it carries light √steps cells, so that smaller cells keep it near where it began, and too "
        "bright there; a learned stencil knows the distances [cells] that it was trained for."
    )
    return Experiment(
        name,
        f"Refinement, {what}",
        "cells along the grid",
        "",
        f"cornell, {what}, as many steps as cells; the scene fills 15 of 32 cells; four light samples per cell "
        f"face at least. Targets' noise {case.noise[component]:.3f}. "
        f"Gradients up to {bench.settings.gradient_cells}³.",
        tuple(readings),
        tuple(limits),
        finding,
        log_knob=True,
    )


def _enough_samples(case: Case, grid: Grid) -> tuple[int, int]:
    """Samples of surfaces and of the lamp: four per cell face where the defaults are fewer."""
    scene, face = case.scene, grid.cell_size**2
    shines = scene.mesh_emission.max(1)[scene.triangle_mesh] > 0
    surface, lamp = float(scene.triangle_areas.sum()), float(scene.triangle_areas[shines].sum())
    return max(8192, int(4 * surface / face)), max(64, int(4 * lamp / face))


def _refined(method: str, own: list[Reading]) -> Limit:
    errors = [r.error or np.nan for r in own]
    best = int(np.nanargmin(errors))
    worse = errors[-1] > 1.1 * errors[best]
    return Limit(
        method,
        "cell size",
        f"best at {own[best].knob:g}³ ({errors[best]:.2f})" + (", gets worse beyond" if worse else ", no worse beyond"),
        f"{errors[-1]:.2f} at {own[-1].knob:g}³",
        _first_told(own) or "not detected: the error needs a truth to be seen",
        ("larger cells" if method.startswith("learned") else "larger cells, or a learned stencil") if worse else "none needed",
    )


def _first_told(own: list[Reading]) -> str:
    told = next((r for r in own if r.message), None)
    return "" if told is None else f"warning from {told.knob:g}³: {told.message.splitlines()[0]}"


def rooms(bench: Bench) -> Experiment:
    """Cells from a twelfth of a room to four rooms."""
    case = traced_case(room_scene(cells=bench.settings.cells), bench.settings, bench.folder)
    low, high = case.scene.bounds
    edge, middle = float((high - low).max()), (low + high) / 2
    readings, limits = [], []
    for name, config in bench.methods.items():
        own = []
        for count in _CELLS_PER_ROOM:
            size = edge / count
            cells = int(np.ceil(count)) + 4
            grid = Grid(tuple(middle - 0.5 * cells * size), size, (cells,) * 3)
            lit = Lit.of(case, config, "bounce1", grid=grid, seed=bench.settings.seed)
            own.append(read(name, 1 / count, lit, replace(config, steps=cells)))
        readings += own
        quiet, told = last_good(own, lambda r: "too large for the rooms" in r.message)
        if quiet is not None and told is not None:
            limits.append(
                Limit(
                    name,
                    "cell / room",
                    f"error {own[0].error:.2f} at a twelfth of the room, {quiet.error:.2f} at {quiet.knob:.2f}",
                    f"{own[-1].error:.2f} with cells of {own[-1].knob:g} rooms: every receiver reads the same few cells",
                    f"warning where a quarter of the receivers have less than 1.5 cells in front of them (silent at "
                    f"{quiet.knob:.2f}, told at {told.knob:.2f})",
                    "at least four cells across the smallest room",
                )
            )
    return Experiment(
        "rooms",
        "Cells larger than rooms",
        "cell / edge of the room",
        "",
        f"A closed cube of {edge:g} m, one bounce. Targets' noise {case.noise['bounce1']:.3f}.",
        tuple(readings),
        tuple(limits),
        "",
        log_knob=True,
    )


def walls(bench: Bench) -> Experiment:
    """A wall without a door between a lit room and a dark one, from a tenth of a cell to three cells."""
    cells = 2 * bench.settings.cells
    size, readings, limits = 10.0 / cells, [], []
    for name, config in bench.methods.items():
        own = []
        for share in _WALLS_IN_CELLS:
            scene = walled_rooms(thickness=share * size, cells=cells, name="walled")
            case = _walled_case(scene, 0.5 * share * size)
            lit = Lit.of(case, config, "bounce1", seed=bench.settings.seed)
            own.append(_leak(name, share, lit, Lpv(lit.light.grid, replace(config, steps=cells))))
        readings += own
        told, quiet = last_good(own, lambda r: "walls are thinner" not in r.message)
        if quiet is not None and told is not None:
            limits.append(
                Limit(
                    name,
                    "wall / cell",
                    f"leak {100 * (own[0].error or 0):.1f} % at {own[0].knob:g} cells, {100 * (told.error or 0):.1f} % at "
                    f"{told.knob:g}, {100 * (own[-1].error or 0):.2g} % at {own[-1].knob:g}",
                    "light passes into a room that has no opening",
                    f"warning below one cell (told at {told.knob:g}, silent at {quiet.knob:g})",
                    "occlusion, and cells smaller than the walls",
                )
            )
    return Experiment(
        "walls",
        "Walls thinner than a cell",
        "wall / cell",
        "",
        f"Two closed rooms of 4 m, the lamp in one, one bounce, cells of {size:.3g} m. The error is the leak: mean irradiance "
        "in the dark room over that in the lit one; the truth is 0.",
        tuple(readings),
        tuple(limits),
        "Without occlusion a wall is no obstacle at any thickness; thicker walls only lie farther from the light.",
        log_knob=True,
        error_label="leak",
    )


def _walled_case(scene: Scene, half: float) -> Case:
    """Receivers on the floors of both rooms and on both sides of the wall between them."""
    along = np.linspace(0.3, 3.7, 6)
    x, z = (a.ravel() for a in np.meshgrid(along, along - 2))
    y = np.linspace(0.3, 2.7, 6)
    side_y, side_z = (a.ravel() for a in np.meshgrid(y, along - 2))
    zero, up, right = np.zeros(36), np.tile([0.0, 1, 0], (36, 1)), np.tile([1.0, 0, 0], (36, 1))
    position = np.concatenate(
        [
            np.stack([-half - x, zero, z], 1),
            np.stack([half + x, zero, z], 1),
            np.stack([zero - half, side_y, side_z], 1),
            np.stack([zero + half, side_y, side_z], 1),
        ]
    )
    normal = np.concatenate([up, up, -right, right])
    return Case(scene, position, normal, np.ones(144), {}, {})


def _leak(name: str, share: float, lit: Lit, lpv: Lpv) -> Reading:
    prediction = solve_irradiance(lpv, lit.light, lit.case.position, lit.case.normal)
    light = prediction.irradiance.sum(1)
    far = lit.case.position[:, 0] > 0
    return Reading(name, share, float(light[far].mean() / light[~far].mean()), message="\n".join(prediction.warnings))


def door(bench: Bench) -> Experiment:
    """The far room of two_rooms_90, which light enters by a door alone, in ever smaller cells."""
    case = bundled_case("two_rooms_90", bench.settings, bench.folder)
    far = dark_receivers("two_rooms_90", case.position)
    assert far is not None
    beyond = replace(
        case,
        position=case.position[far],
        normal=case.normal[far],
        weight=case.weight[far],
        truth={c: t[far] for c, t in case.truth.items()},
    )
    readings, limits = [], []
    for name, config in bench.methods.items():
        own = []
        for cells in [n for n in bench.settings.refinement if n <= 64]:
            grid = case.grid.with_cells(cells)
            lit = Lit.of(beyond, config, "bounce1", grid=grid, seed=bench.settings.seed)
            by = "propagation" if cells <= bench.settings.gradient_cells else None
            own.append(read(name, cells, lit, replace(config, steps=cells), by=by))
        readings += own
        best = min(own, key=lambda r: r.error or np.inf)
        limits.append(
            Limit(
                name,
                "door of two_rooms",
                f"far room: error {best.error:.2f} at best ({best.knob:g}³ cells)",
                f"{own[-1].error:.2f} at {own[-1].knob:g}³, {own[-1].energy:.2f} times the true light",
                "warning: walls thinner than a cell, in all of these grids",
                "cells of half the door or less" + ("" if "exp" in name else ", and occlusion"),
            )
        )
    share = float(np.average(beyond.truth["bounce1"].sum(1)) / np.average(case.truth["bounce1"][~far].sum(1)))
    return Experiment(
        "door",
        "The door of two_rooms_90",
        "cells along the grid of 9 m",
        "",
        f"Receivers of the far room only, one bounce; they get {100 * share:.1f} % of what the lit room gets. The wall is "
        f"0.1 m thick, the door 1 m wide. Targets' noise over both rooms {case.noise['bounce1']:.3f}.",
        tuple(readings),
        tuple(limits),
        "",
        log_knob=True,
    )
