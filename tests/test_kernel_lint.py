"""Forms that Warp compiles without a word and gets wrong, or that cost minutes: banned from every kernel and function."""

import ast
import re
from pathlib import Path

import pytest

FILES = sorted((Path(__file__).resolve().parents[1] / "warp_kernels").glob("*.py"))


def device_functions(tree):
    """Every function decorated with ``wp.kernel`` or ``wp.func``, with its decorator's text."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            for decorator in node.decorator_list:
                text = ast.unparse(decorator)
                if text.startswith(("wp.kernel", "wp.func")):
                    yield node, text


def bad_forms(source):
    """Every banned form of a source text, as lines that name function, line and reason."""
    found = []
    for function, decorator in device_functions(ast.parse(source)):
        if decorator.startswith("wp.kernel") and "enable_backward=False" not in decorator:
            found.append(f"{function.name}: kernel without enable_backward=False")
        for node in ast.walk(function):
            if isinstance(node, ast.While):
                found.append(f"{function.name}:{node.lineno}: while")
            elif isinstance(node, ast.Continue):
                found.append(f"{function.name}:{node.lineno}: continue")
            elif isinstance(node, ast.AugAssign) and isinstance(node.target, ast.Subscript):
                if isinstance(node.op, ast.Mult | ast.Div):
                    found.append(f"{function.name}:{node.lineno}: *= or /= on an element")
            elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Subscript):
                target = ast.unparse(node.targets[0])
                if target in [ast.unparse(part) for part in ast.walk(node.value) if isinstance(part, ast.Subscript)]:
                    found.append(f"{function.name}:{node.lineno}: v[i] = v[i] + x")
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_kernels_avoid_the_bad_forms(path):
    assert bad_forms(path.read_text()) == []


def test_the_lint_sees_kernels():
    counts = {path.name: sum(1 for _ in device_functions(ast.parse(path.read_text()))) for path in FILES}
    assert all(counts[name] >= 2 for name in ("injection.py", "sampling.py", "occlusion.py", "sh.py"))


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("while x < 3: x += 1", "while"),
        ("for i in range(n):\n        if i == 2: continue", "continue"),
        ("a[i] *= 2.0", r"\*="),
        ("v[i] = v[i] + x", r"v\[i\]"),
    ],
)
def test_each_ban_can_fail(body, message):
    found = bad_forms(f"@wp.kernel(enable_backward=False)\ndef k(a: int):\n    {body}\n")
    assert len(found) == 1
    assert re.search(message, found[0])
    assert bad_forms("@wp.kernel\ndef k(a: int): pass") == ["k: kernel without enable_backward=False"]
