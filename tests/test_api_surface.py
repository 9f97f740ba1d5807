"""What users may call: every module says so in ``__all__``, each symbol is documented and has one home.

The public surface of ``difflpv`` is pinned in ``tests/data/api_surface.txt``. After an intended change, renew it with
``python tests/test_api_surface.py`` and read the difference before committing it.
"""

from __future__ import annotations

import ast
import difflib
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SNAPSHOT = ROOT / "tests" / "data" / "api_surface.txt"
PACKAGES = ("difflpv", "warp_kernels", "data_gen")
# Twins carry the names of the stages that they check, commands all have the same two entry points.
NOT_PINNED = ("difflpv.reference", "difflpv.cli")


def project_modules() -> dict[str, Path]:
    """Module name -> file; programs (``__main__``) and private modules apart."""
    modules = {}
    for folder in PACKAGES:
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            parts = parts[:-1] if parts[-1] == "__init__" else parts
            if not any(part.startswith("_") for part in parts):
                modules[".".join(parts)] = path
    return modules


MODULES = project_modules()


def is_pinned(module: str) -> bool:
    """True for the modules whose names and signatures the snapshot holds."""
    return module.split(".")[0] == "difflpv" and not any(
        module == name or module.startswith(name + ".") for name in NOT_PINNED
    )


def public_names(tree: ast.Module) -> list[str] | None:
    """The literal ``__all__`` of a module, None if it has none."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and any(isinstance(t, ast.Name) and t.id == "__all__" for t in node.targets):
            return list(ast.literal_eval(node.value))
    return None


def definitions(tree: ast.Module) -> dict[str, ast.stmt]:
    """Top-level functions, classes and assigned names of a module (imports are not definitions)."""
    found: dict[str, ast.stmt] = {}
    for node in tree.body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            found[node.name] = node
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            for name in (n for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)):
                found[name.id] = node
    return found


def signature(function: ast.FunctionDef, *, method: bool = False) -> str:
    """Arguments and return type as written, without ``self``."""
    arguments = ast.unparse(function.args)
    if method and not any(ast.unparse(d) == "staticmethod" for d in function.decorator_list):
        arguments = arguments.partition(", ")[2] if ", " in arguments else ""
    returns = f" -> {ast.unparse(function.returns)}" if function.returns else ""
    return f"{function.name}({arguments}){returns}"


def describe_class(node: ast.ClassDef) -> list[str]:
    """A class's line, its fields and its public methods."""
    lines = [f"class {node.name}({', '.join(ast.unparse(base) for base in node.bases)})"]
    for item in node.body:
        if isinstance(item, ast.AnnAssign) and not ast.unparse(item.target).startswith("_"):
            default = " = ..." if item.value is not None else ""
            lines.append(f"    {ast.unparse(item.target)}: {ast.unparse(item.annotation)}{default}")
        elif isinstance(item, ast.Assign) and not ast.unparse(item.targets[0]).startswith("_"):
            lines.append(f"    {ast.unparse(item.targets[0])} = {ast.unparse(item.value)}")  # a member of an Enum
        elif isinstance(item, ast.FunctionDef) and (item.name == "__init__" or not item.name.startswith("_")):
            decorators = [ast.unparse(d) for d in item.decorator_list]
            kind = next((f"[{d}] " for d in decorators if d in ("classmethod", "staticmethod")), "")
            kind = "[property] " if any("property" in d for d in decorators) else kind
            lines.append(f"    {kind}{signature(item, method=True)}")
    return lines


def surface() -> str:
    """The public surface of difflpv as text: module, names, signatures."""
    blocks = []
    for module, path in MODULES.items():
        tree = ast.parse(path.read_text())
        names = public_names(tree)
        if not is_pinned(module) or not names:
            continue
        defined = definitions(tree)
        lines = [module]
        for name in sorted(names):
            node = defined.get(name)
            if isinstance(node, ast.FunctionDef):
                lines.append(f"    {signature(node)}")
            elif isinstance(node, ast.ClassDef):
                lines += [f"    {line}" for line in describe_class(node)]
            else:
                lines.append(f"    {name}")
        blocks.append("\n".join(lines))
    return "\n\n".join(blocks) + "\n"


@pytest.mark.parametrize("module", MODULES)
def test_module_says_what_is_public(module):
    tree = ast.parse(MODULES[module].read_text())
    if MODULES[module].name == "__init__.py" and len(tree.body) <= 1:
        return  # a package that holds modules and nothing else
    names = public_names(tree)
    assert names is not None, f"{module}: no __all__"
    assert len(names) == len(set(names)), f"{module}: a name stands twice in __all__"
    assert not [name for name in names if name.startswith("_") and name != "__version__"]


@pytest.mark.parametrize("module", MODULES)
def test_public_symbols_are_documented(module):
    tree = ast.parse(MODULES[module].read_text())
    assert ast.get_docstring(tree), f"{module}: no module docstring"
    defined = definitions(tree)
    bare = []
    for name in public_names(tree) or []:
        node = defined.get(name)
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            bare += [] if ast.get_docstring(node) else [name]
        if isinstance(node, ast.ClassDef):
            methods = [m for m in node.body if isinstance(m, ast.FunctionDef) and not m.name.startswith("_")]
            bare += [f"{name}.{m.name}" for m in methods if not ast.get_docstring(m)]
    assert not bare, f"{module}: no docstring: {bare}"


@pytest.mark.parametrize("module", MODULES)
def test_module_defines_what_it_publishes(module):
    if MODULES[module].name == "__init__.py":
        return  # only a package may publish what another module defines
    tree = ast.parse(MODULES[module].read_text())
    borrowed = set(public_names(tree) or []) - set(definitions(tree))
    assert not borrowed, f"{module}: in __all__ but defined elsewhere: {sorted(borrowed)}"


def test_each_symbol_has_one_public_path():
    homes: dict[str, str] = {}
    twice = []
    for module, path in MODULES.items():
        tree = ast.parse(path.read_text())
        defined = definitions(tree)
        for name in public_names(tree) or []:
            if is_pinned(module) and name in defined:
                twice += [f"{name}: {homes[name]} and {module}"] if name in homes else []
                homes[name] = module
    assert not twice, "\n".join(twice)


def test_package_publishes_what_the_modules_define():
    package = importlib.import_module("difflpv")
    homes = {}
    for module in filter(is_pinned, MODULES):
        tree = ast.parse(MODULES[module].read_text())
        homes.update(dict.fromkeys(set(public_names(tree) or []) & set(definitions(tree)), module))
    for name in set(package.__all__) - {"__version__"}:
        assert getattr(package, name) is getattr(importlib.import_module(homes[name]), name), name
    assert set(package.__all__) <= set(dir(package))


def test_surface_is_the_pinned_one():
    pinned, now = SNAPSHOT.read_text().splitlines(), surface().splitlines()
    difference = "\n".join(difflib.unified_diff(pinned, now, "pinned", "now", lineterm="", n=1))
    assert not difference, f"if this is intended, run 'python tests/test_api_surface.py'\n{difference}"


if __name__ == "__main__":
    SNAPSHOT.write_text(surface())
    print(f"wrote {SNAPSHOT.relative_to(ROOT)}")
