"""Imports point one way only, and each outside library has one door. The tables below are the rules.

A new module belongs into ``LAYERS`` (the tests say so by name); a new library into ``LIBRARY_OWNERS`` if only one part
of the project may know it. Tests and benchmarks may import everything.
"""

from __future__ import annotations

import ast
import graphlib
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
CHECKED = ("difflpv", "warp_kernels", "data_gen", "scripts")
MAX_LINES = 400
MAX_TEST_LINES = 600

# Lowest first. A module may import modules of its own layer and of the layers above it in this table. A name stands for
# itself and for everything below it, unless a longer name is listed too.
LAYERS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("kernels", ("warp_kernels",)),
    (
        "values",
        (
            "difflpv.camera_view",
            "difflpv.error_bounds",
            "difflpv.grid",
            "difflpv.io",
            "difflpv.lights",
            "difflpv.parameters",
            "difflpv.raycast",
            "difflpv.scene",
            "difflpv.sh",
            "difflpv.shapes",
            "difflpv.triangle_distance",
        ),
    ),
    ("bridge", ("difflpv.bridge", "difflpv.coordinates", "difflpv.slabs", "difflpv.vpl")),
    (
        "stages",
        (
            "difflpv.attenuation",
            "difflpv.convolution",
            "difflpv.damping",
            "difflpv.direct",
            "difflpv.face_propagation",
            "difflpv.injection",
            "difflpv.io.exports",  # formats of engines: they know light probes, which difflpv.io below does not
            "difflpv.linear_propagation",
            "difflpv.lit_probes",
            "difflpv.lookup",
            "difflpv.loss",
            "difflpv.occlusion",
            "difflpv.padded",
            "difflpv.probes",
            "difflpv.propagation",
            "difflpv.reference",
            "difflpv.rsm",
            "difflpv.sampling",
            "difflpv.stability",
            "difflpv.stencil",
            "difflpv.stencil_coordinates",
            "difflpv.stencil_files",
            "difflpv.surface",
            "difflpv.symmetry",
            "difflpv.traced",
            "difflpv.weighted",
        ),
    ),
    (
        "pipeline",
        (
            "difflpv.blocking",
            "difflpv.config",
            "difflpv.config_file",
            "difflpv.fitted",
            "difflpv.illumination",
            "difflpv.learnables",
            "difflpv.pipeline",
        ),
    ),
    ("optim", ("difflpv.optim",)),
    ("data_gen", ("data_gen",)),
    (
        "jobs",
        (
            "difflpv.evaluate",
            "difflpv.fit",
            "difflpv.leakage",
            "difflpv.placement",
            "difflpv.simulate",
            "difflpv.training",
            "difflpv.trouble",
        ),
    ),
    ("report", ("difflpv.report",)),
    ("demo", ("difflpv.bench", "difflpv.demo", "difflpv.planning", "difflpv.stress", "difflpv.viewer")),
    ("cli", ("difflpv.cli",)),
    ("scripts", ("scripts",)),
)


@dataclass(frozen=True)
class Only:
    """Modules under ``module`` import nothing of this project but ``first_party``; ``banned`` libraries never."""

    module: str
    why: str
    first_party: tuple[str, ...]
    banned: tuple[str, ...] = ()


ONLY = (
    Only(
        "warp_kernels",
        "kernels know neither torch nor the project around them",
        first_party=("warp_kernels",),
        banned=("torch",),
    ),
    Only(
        "difflpv.reference",
        "a twin that shares code with what it checks checks nothing",
        first_party=("difflpv.reference", "difflpv.sh", "difflpv.grid"),
        banned=("warp",),
    ),
    Only(
        "difflpv.optim",
        "solvers know problems, never scenes or transport",
        first_party=("difflpv.optim", "difflpv.parameters", "difflpv.io"),
        banned=("warp", "trimesh", "embreex"),
    ),
    Only(
        "data_gen",
        "the judge never shares the transport that it judges, and its workers start quickly",
        first_party=(
            "data_gen",
            "difflpv.grid",
            "difflpv.io",
            "difflpv.lights",
            "difflpv.raycast",
            "difflpv.scene",
            "difflpv.sh",
            "difflpv.triangle_distance",
        ),
        banned=("torch", "warp"),
    ),
)

# Only these parts may know the path tracer: what they judge must not.
DATA_GEN_USERS = (
    "data_gen", "difflpv.bench", "difflpv.cli", "difflpv.demo", "difflpv.placement.from_targets",
    "difflpv.placement.held_out", "difflpv.planning", "difflpv.stress", "difflpv.training", "scripts",
)  # fmt: skip

LIBRARY_OWNERS: dict[str, tuple[str, ...]] = {
    "warp": ("warp_kernels", "difflpv.bridge", "difflpv.face_propagation"),
    "OpenEXR": ("difflpv.io.exr",),
    "PIL": ("difflpv.io.png", "difflpv.io.texture"),
    "trimesh": ("difflpv.io.obj", "difflpv.io.ply", "difflpv.io.gltf"),
    "embreex": ("difflpv.raycast",),
    "nlopt": ("difflpv.optim.nlopt_solver",),
    "cma": ("difflpv.optim.cma_solver",),
    "kornia": ("difflpv.loss",),
    "safetensors": ("difflpv.fitted", "difflpv.probes.probe_files", "difflpv.stencil_files"),
    "matplotlib": ("difflpv.report", "scripts"),
    "tqdm": ("data_gen", "difflpv.cli", "scripts"),
    "viser": ("difflpv.viewer.page",),
    "flip_evaluator": ("difflpv.bench.images",),
    "mitsuba": ("difflpv.bench.mitsuba_gradient", "difflpv.bench.mitsuba_peer"),
    "drjit": ("difflpv.bench.mitsuba_gradient", "difflpv.bench.mitsuba_peer"),
}

# What every path-tracing worker and `difflpv --help` import: torch or Warp would cost each of them seconds.
QUICK_IMPORTS = ("difflpv", "difflpv.scene", "difflpv.sh", "difflpv.grid", "difflpv.io", "difflpv.cli", "data_gen")


@dataclass(frozen=True)
class Import:
    """One imported module, or name of a module, with its line."""

    target: str
    line: int
    lazy: bool


def within(module: str, prefixes: Iterable[str]) -> bool:
    """True if ``module`` is one of ``prefixes`` or lies below one."""
    return any(module == prefix or module.startswith(prefix + ".") for prefix in prefixes)


def layer_of(module: str) -> int | None:
    """Index in ``LAYERS`` of the longest listed name that covers ``module``."""
    covering = [
        (len(name), index) for index, (_, names) in enumerate(LAYERS) for name in names if within(module, [name])
    ]
    return max(covering)[1] if covering else None


def imports_of(module: str, source: str, known: Iterable[str], *, is_package: bool = False) -> list[Import]:
    """All imports of a source text, those inside functions and ``if TYPE_CHECKING`` included (``lazy``)."""
    known, tree = frozenset(known), ast.parse(source)
    found: list[Import] = []
    used = {n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute) and ast.unparse(n.value) == "difflpv"}
    version_only = used == {"__version__"}

    def visit(node: ast.AST, lazy: bool) -> None:
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names if not (alias.name == "difflpv" and version_only)]
            found.extend(Import(name, node.lineno, lazy) for name in names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parts = module.split(".") if is_package else module.split(".")[:-1]
                parts = parts[: len(parts) - node.level + 1]
                base = ".".join([*parts, base] if base else parts)
            for alias in node.names:
                if base == "difflpv" and alias.name == "__version__":
                    continue
                submodule = f"{base}.{alias.name}"
                found.append(Import(submodule if submodule in known else base, node.lineno, lazy))
        lazy = lazy or isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
        typing_only = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for child in ast.iter_child_nodes(node):
            visit(child, lazy or typing_only)

    visit(tree, False)
    return found


def violations(module: str, source: str, known: Iterable[str] = (), *, is_package: bool = False) -> list[str]:
    """Every broken rule of one module, as lines that name it."""
    broken: list[str] = []
    stem = module.rpartition(".")[2]
    if stem in ("utils", "util", "helpers", "misc", "common"):
        broken.append(f"{module}: no drawer modules: name it after what it holds")
    if source.count("\n") > MAX_LINES:
        broken.append(f"{module}: {source.count(chr(10))} lines, at most {MAX_LINES}: split it by what it does")
    own_layer = layer_of(module)
    if own_layer is None and module != "difflpv":
        return [*broken, f"{module}: in no layer: add it to LAYERS in tests/test_layering.py"]
    for item in imports_of(module, source, known, is_package=is_package):
        where, target = f"{module}:{item.line}", item.target
        library = target.partition(".")[0]
        owners = LIBRARY_OWNERS.get(library)
        if owners is not None and not within(module, owners):
            broken.append(f"{where}: imports {library}, which only {', '.join(owners) or 'no module'} may know")
        for rule in ONLY:
            if within(module, [rule.module]):
                foreign = within(target, CHECKED) and not within(target, rule.first_party)
                if foreign or library in rule.banned:
                    broken.append(f"{where}: {rule.module} imports {target}: {rule.why}")
        if within(target, ["data_gen"]) and not within(module, DATA_GEN_USERS):
            broken.append(f"{where}: imports {target}: only {', '.join(DATA_GEN_USERS)} may know the path tracer")
        if not within(target, CHECKED) or own_layer is None:
            continue
        if target == "difflpv":
            if own_layer < len(LAYERS) - 2:  # commands and scripts are users like any other
                broken.append(f"{where}: imports the package root: name the module that defines it")
            continue
        target_layer = layer_of(target)
        if target_layer is None:
            broken.append(f"{where}: imports {target}, which is in no layer: add it to LAYERS")
        elif target_layer > own_layer:
            broken.append(
                f"{where}: {LAYERS[own_layer][0]} imports {target} of the layer above it, {LAYERS[target_layer][0]}"
            )
    return list(dict.fromkeys(broken))


def project_modules() -> dict[str, Path]:
    """Module name -> file of everything that the rules cover."""
    modules = {}
    for folder in CHECKED:
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            modules[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return modules


MODULES = project_modules()


@pytest.mark.parametrize("module", MODULES)
def test_module_obeys_the_rules(module):
    path = MODULES[module]
    broken = violations(module, path.read_text(), MODULES, is_package=path.name == "__init__.py")
    assert not broken, "\n".join(broken)


def test_no_import_cycle():
    graph: dict[str, set[str]] = {}
    for module, path in MODULES.items():
        items = imports_of(module, path.read_text(), MODULES, is_package=path.name == "__init__.py")
        graph[module] = {item.target for item in items if not item.lazy and item.target in MODULES} - {module}
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError, which names the cycle


def test_layers_list_no_module_twice():
    names = [name for _, names in LAYERS for name in names]
    assert len(names) == len(set(names))


def test_tests_and_benchmarks_stay_readable():
    files = [*(ROOT / "tests").rglob("*.py"), *(ROOT / "benchmarks").rglob("*.py")]
    too_long = [f"{f.relative_to(ROOT)}: {n}" for f in files if (n := f.read_text().count("\n")) > MAX_TEST_LINES]
    assert not too_long, f"more than {MAX_TEST_LINES} lines: {too_long}"


@pytest.mark.parametrize("module", QUICK_IMPORTS)
def test_quick_import_loads_neither_torch_nor_warp(module):
    program = f"import sys, {module}; print([m for m in ('torch', 'warp', 'kornia', 'matplotlib') if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "[]"


def test_path_tracer_runs_without_torch_and_warp():
    names = [name for name in MODULES if within(name, ["data_gen"]) and not name.endswith("__main__")]
    program = f"import sys, {', '.join(names)}; print([m for m in ('torch', 'warp') if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "[]"


# One breach per rule: a rule that cannot fail protects nothing.
BREACHES = {
    "upward import": ("difflpv.propagation", "from difflpv.pipeline import Lpv", "of the layer above"),
    "upward import inside a function": (
        "difflpv.injection",
        "def f():\n    from difflpv.optim import solve",
        "of the layer above",
    ),
    "upward import for types": (
        "difflpv.vpl",
        "if TYPE_CHECKING:\n    from difflpv.rsm import Rsm",
        "of the layer above",
    ),
    "upward relative import": ("difflpv.io.gltf", "from ..pipeline import Lpv", "of the layer above"),
    "upward import of a module by name": ("difflpv.scene", "from difflpv import pipeline", "of the layer above"),
    "library imports a script": ("difflpv.cli", "import scripts.fit_cornell", "of the layer above"),
    "package root": ("difflpv.sampling", "from difflpv import load_scene", "package root"),
    "package root by name": ("difflpv.sampling", "import difflpv\ndifflpv.load_scene()", "package root"),
    "unknown module": ("difflpv.octree", "import numpy", "in no layer"),
    "unknown target": ("difflpv.cli", "import difflpv.octree", "in no layer"),
    "kernel knows torch": ("warp_kernels.injection", "import torch", "neither torch"),
    "kernel knows the project": ("warp_kernels.injection", "from difflpv.sh import sh_basis", "neither torch"),
    "twin shares the stage": ("difflpv.reference.injection", "from difflpv.stencil import lpv_stencil", "a twin that"),
    "solver knows scenes": ("difflpv.optim.adam", "from difflpv.scene import Scene", "never scenes"),
    "solver knows the pipeline": ("difflpv.optim.adam", "from difflpv.pipeline import Lpv", "never scenes"),
    "judge shares the transport": ("data_gen.pathtracer", "from difflpv.sampling import sample", "the judge never"),
    "judge loads torch": ("data_gen.targets", "def f():\n    import torch", "the judge never"),
    "judged knows the judge": ("difflpv.fit", "from data_gen.pathtracer import PathTracer", "may know the path tracer"),
    "second door to a library": ("difflpv.report", "import OpenEXR", "which only difflpv.io.exr"),
    "second door to warp": ("difflpv.loss", "import warp as wp", "which only warp_kernels"),
    "drawer module": ("difflpv.io.utils", "", "no drawer"),
    "too long": ("difflpv.loss", "x = 1\n" * (MAX_LINES + 1), "split it"),
}


@pytest.mark.parametrize("breach", BREACHES)
def test_each_rule_can_fail(breach):
    module, source, expected = BREACHES[breach]
    known = {"difflpv.pipeline", *MODULES}
    assert any(expected in line for line in violations(module, source, known)), violations(module, source, known)


def test_good_module_breaks_no_rule():
    source = "import torch\nfrom difflpv.bridge import launch\nfrom . import stencil\nimport warp_kernels.injection\n"
    known = {"difflpv.stencil", "warp_kernels.injection", *MODULES}
    assert violations("difflpv.injection", source, known) == []
    assert violations("difflpv.fitted", "import difflpv\nprint(difflpv.__version__)", known) == []
    assert violations("difflpv.fitted", "from difflpv import __version__", known) == []
    assert violations("difflpv.cli.demo", "from difflpv import load_scene\nimport data_gen.targets\n", known) == []
