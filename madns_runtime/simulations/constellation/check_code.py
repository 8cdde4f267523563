"""
Finds out, without running any of it, whether code that a scenario names is there.

For `cosmos validate`: a file is parsed, not imported. What it does when it is imported shows on the agent.
"""

from __future__ import annotations

import ast
import importlib.util
from collections.abc import Iterator, Sequence
from pathlib import Path

from madns_runtime.plugin.registry import is_file


def code_faults(
    field: str, spec: str, base_directory: Path, *, forbidden: Sequence[str] = ()
) -> list[str]:
    """
    Return what is wrong with a class that a scenario names.

    Args:
        field: Dotted name of the parameter.
        spec: file.py:Class beside the scenario, or module:Class.
        base_directory: Folder of the scenario.
        forbidden: Modules that its file must not import, nor what is below them.
    """
    place, _, name = spec.rpartition(":")
    if not place or not name.isidentifier():
        return [f"{field}: expected file.py:Class or module:Class, got {spec!r}"]
    if not is_file(spec):
        top = place.partition(".")[0]
        if not top.isidentifier() or importlib.util.find_spec(top) is None:
            return [f"{field}: no module {top!r} here; a file is written {place}.py:{name}"]
        return []
    path = base_directory / place
    if not path.is_file():
        return [f"{field}: no such file: {path}"]
    try:
        tree = ast.parse(path.read_text(encoding="utf-8"), str(path))
    except SyntaxError as error:
        return [f"{field}: {path}:{error.lineno}: {error.msg}"]
    except (OSError, ValueError) as error:
        return [f"{field}: {path} cannot be read: {error}"]
    faults = [
        f"{field}: {path}:{line}: expected no import of {module}: flight software sees what its "
        "context gives it"
        for line, module in _imports(tree)
        if any(f"{module}.".startswith(f"{one}.") for one in forbidden)
    ]
    names = set(_names(tree))
    if name not in names and "*" not in names:
        classes = [node.name for node in tree.body if isinstance(node, ast.ClassDef)]
        told = f"; it has {', '.join(classes)}" if classes else ""
        faults.append(f"{field}: {path} has no class {name!r}{told}")
    return faults


def _imports(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield line and module of every import, wherever it stands; what is taken from a package may be a module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield from ((node.lineno, f"{node.module}.{alias.name}") for alias in node.names)


def _names(tree: ast.Module) -> Iterator[str]:
    """Yield what a module's own lines bind, wherever below an if or a try they stand."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            yield node.name
        elif isinstance(node, ast.Import | ast.ImportFrom):
            for alias in node.names:
                yield (alias.asname or alias.name).partition(".")[0]
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
