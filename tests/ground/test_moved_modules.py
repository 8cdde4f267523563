"""Old import paths: they work for one release and say what to write instead."""

import ast
import importlib
import importlib.util
import re
import sys
from pathlib import Path

import pytest

from madns_runtime.moved_modules import MovedModule

ROOT = Path(__file__).parents[2]
FLIGHT = "madns_runtime.simulations.constellation.flight"


MOVED = [("ring", "ring_consensus", "RingMember"), ("hearsay", "gossip", "Known")]


@pytest.mark.parametrize(("old", "new", "name"), MOVED)
def test_old_path_hands_over_what_stands_at_the_new_one_with_a_warning(old, new, name):
    told = f"{FLIGHT}.{old} is {FLIGHT}.{new} now; the old path goes with the next release"
    code = f"from {FLIGHT}.{old} import {name}"
    found = {}

    with pytest.warns(FutureWarning) as caught:
        exec(code, found)

    assert found[name] is getattr(importlib.import_module(f"{FLIGHT}.{new}"), name)
    # Others may be of what other tests left unclosed.
    ours = [warning for warning in caught if warning.category is FutureWarning]
    assert [str(warning.message) for warning in ours] == [told]


def test_name_that_the_new_path_does_not_have_is_no_import():
    with pytest.raises(ImportError, match="cannot import name 'Nobody'"):
        exec(f"from {FLIGHT}.ring import Nobody", {})


def test_packages_themselves_use_the_new_paths():
    importlib.import_module(FLIGHT)
    old = {f"{FLIGHT}.{name}" for name, _, _ in MOVED}
    folders = ("cosmos_cli", "madns_runtime", "scenarios")
    paths = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    codes = {path.relative_to(ROOT): path.read_text("utf-8") for path in paths}
    last_word = re.compile(rf"\b({'|'.join(name for name, _, _ in MOVED)})\b")

    used = {
        f"{path}: {name}"
        for path, code in codes.items()
        if last_word.search(code)
        for name in old & set(_named_modules(code, path))
    }

    assert old == {name for name, each in sys.modules.items() if isinstance(each, MovedModule)}
    assert len(codes) > 500
    assert used == set()


@pytest.mark.parametrize(
    "code",
    [
        f"import {FLIGHT}.ring",
        f"def f():\n    import {FLIGHT}.ring as own",
        f"from {FLIGHT} import ring",
        f"from {FLIGHT}.ring import RingMember",
        "from . import ring",
        "from .ring import RingMember",
        "from ..flight.ring import RingMember",
        f"import_module('{FLIGHT}.ring')",
    ],
)
def test_old_path_is_found_however_it_is_written(code):
    path = Path(*FLIGHT.split("."), "hohmann.py")

    assert f"{FLIGHT}.ring" in set(_named_modules(code, path))
    assert f"{FLIGHT}.ring" not in set(_named_modules(code.replace("ring", "ring_consensus"), path))


def _named_modules(code, path):
    """Yield what a file imports, modules and names alike, and its texts, which `import_module` may be given."""
    package = ".".join(path.parts[:-1])
    code = re.sub(r"@([A-Z]+)@", r"\1", code)  # a template's place for a name
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            yield module
            yield from (f"{module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value
