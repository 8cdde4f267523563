"""One word, one thing: names of modules and classes that tell what is in them, and say it once."""

import ast
import functools
import gc
import importlib
import re
from collections import defaultdict
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("cosmos_cli", "madns_runtime")
LATE_IMPORTS_MAX = 40
"""Imports inside functions in both packages: start-up time that is worth one each."""
FUNCTION_LINES_MAX = 70
MODULE_LINES_MAX = 400
PRONOUN = re.compile(r"(what|whatever|who|whoever|whom|whose)\b", re.IGNORECASE)
FILES = sorted(
    path
    for package in PACKAGES
    for path in (ROOT / package).rglob("*.py")
    if "templates" not in path.parts
)
WITH_TESTS = sorted(
    path
    for folder in ("tests", "benchmarks", "docs", "scenarios")
    for path in (ROOT / folder).rglob("*.py")
)
# Names that did not tell what stood there: nobody finds anything at them again.
GONE = """
madns_runtime: half host_port agent_port
madns_runtime.plugin: returned questions guard
madns_runtime.lockstep: half crew meeting post shares watch
madns_runtime.reactor: lines
madns_runtime.protocol: wire silence best
madns_runtime.simulations.constellation: hosting check_board
madns_runtime.simulations.constellation.truth: jobs pieces choice fleet medium
madns_runtime.simulations.constellation.vehicle: board cockpit fitting
madns_runtime.simulations.constellation.vehicle.sensors: scene
madns_runtime.simulations.constellation.flight: pilot answers ring
madns_runtime.simulations.constellation.orbit: turning
cosmos_cli.launch: crew roll seats talk pulse machine_care places living elsewhere loop starter
cosmos_cli.fleet: board wire headstart opening remembered silence watched ordered output names onboard
cosmos_cli.fleet.onboard: keep store living busy wakeups evidence round_trips
cosmos_cli.onboard: keep store living busy wakeups evidence round_trips
cosmos_cli.provision: kit brought parts look notes wanted declared ready
cosmos_cli.retrieve: claims offer incoming account notes
cosmos_cli: counted measured spread earlier refusals still_running expectation gather packets
"""


@functools.cache
def tree_of(file):
    return ast.parse(file.read_text(encoding="utf-8"))


@pytest.fixture(scope="module", autouse=True)
def trees():
    """Keep all trees for the tests of this file alone: collections of garbage among their nodes take twice as long as they do."""
    gc.disable()
    yield
    tree_of.cache_clear()
    gc.enable()


def is_module(path):
    file = ROOT.joinpath(*path.split("."))
    return file.with_suffix(".py").exists() or (file / "__init__.py").exists()


def test_no_module_stands_at_a_name_that_did_not_tell():
    gone = [
        f"{package}.{name}"
        for package, names in (line.split(":") for line in GONE.split("\n") if line)
        for name in names.split()
    ]

    assert len(gone) > 50
    assert [path for path in gone if is_module(path)] == []


def test_no_two_public_classes_share_a_name():
    places = defaultdict(list)
    for file in FILES:
        for node in tree_of(file).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(str(file.relative_to(ROOT)))

    assert len(places) > 500
    assert {name: found for name, found in places.items() if len(found) > 1} == {}


def functions_of(file):
    """Yield (name, lines) of each function, from its first decorator to its end."""
    for node in ast.walk(tree_of(file)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            first = min(each.lineno for each in (node, *node.decorator_list))
            yield node.name, node.end_lineno - first + 1


def texts_of(file):
    """Yield the docstrings of a file, those below attributes and constants among them."""
    for node in ast.walk(tree_of(file)):
        match node:
            case ast.Expr(value=ast.Constant(value=str(text))):
                yield f"{file.relative_to(ROOT)}:{node.lineno}", text.strip()


def test_docstrings_open_with_a_noun_or_a_verb():
    texts = dict(text for file in FILES for text in texts_of(file))

    assert len(texts) > 9000
    assert {place: text for place, text in texts.items() if PRONOUN.match(text)} == {}


def test_functions_fit_a_screen():
    everywhere = [*FILES, *WITH_TESTS]
    lengths = [
        (str(file.relative_to(ROOT)), *found) for file in everywhere for found in functions_of(file)
    ]

    assert len(lengths) > 5000
    assert [each for each in lengths if each[-1] > FUNCTION_LINES_MAX] == []


def test_modules_are_no_longer_than_a_subject_needs():
    lengths = {
        str(file.relative_to(ROOT)): file.read_text(encoding="utf-8").count("\n")
        for file in [*FILES, *(ROOT / "benchmarks").rglob("*.py")]
    }

    assert len(lengths) > 400
    assert {name: lines for name, lines in lengths.items() if lines > MODULE_LINES_MAX} == {}


@pytest.mark.parametrize("told", ["type: ignore", "noqa: "])
def test_what_checkers_are_told_to_ignore_has_its_reason_beside_it(told):
    found = [
        (f"{file.relative_to(ROOT)}:{number}", line.strip())
        for file in FILES
        for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1)
        if f"# {told}" in line
    ]

    assert len(found) > 10
    reason = re.compile(r"# (type: ignore\[[\w, -]+\]  # |noqa: [A-Z0-9, ]+ - )\w")
    assert [each for each in found if not reason.search(each[1])] == []


def circles(graph):
    """Groups of modules each of which imports the others, directly or not (Tarjan's algorithm)."""
    order, low, on_stack, stack, found = {}, {}, set(), [], []

    def visit(module):
        order[module] = low[module] = len(order)
        stack.append(module)
        on_stack.add(module)
        for other in graph.find_modules_directly_imported_by(module):
            if other not in order:
                visit(other)
                low[module] = min(low[module], low[other])
            elif other in on_stack:
                low[module] = min(low[module], order[other])
        if low[module] == order[module]:
            group = set()
            while module not in group:
                group.add(stack.pop())
            on_stack.difference_update(group)
            if len(group) > 1:
                found.append(group)

    for module in sorted(graph.modules):
        if module not in order:
            visit(module)
    return found


def test_no_modules_import_each_other_also_not_behind_late_imports():
    graph = grimp.build_graph(*PACKAGES, exclude_type_checking_imports=True, cache_dir=None)

    assert len(graph.modules) > 400
    assert circles(graph) == []


def test_public_import_paths_of_the_guide_work():
    text = (ROOT / "docs/plugins.md").read_text(encoding="utf-8")
    table = text.partition("## Import paths that stay")[2].partition("\n## ")[0]
    rows = re.findall(
        r"^\| `((?:madns_runtime|cosmos_cli)[\w.]*)` \| (.*) \|$", table, re.MULTILINE
    )
    names = [(path, name) for path, cell in rows for name in re.findall(r"`(\w+)`", cell)]

    assert len(rows) > 10
    missing = [
        (path, name) for path, name in names if not hasattr(importlib.import_module(path), name)
    ]
    assert missing == []


def imported_by(text):
    """Yield (module, name) of our packages for each import statement in a text that may be no Python."""
    for path, listed in re.findall(
        r"^\s*from ((?:madns_runtime|cosmos_cli)[\w.]*) import (\([^)]*\)|[^\n#]*)",
        text,
        re.MULTILINE,
    ):
        for name in re.findall(r"\w+", listed.partition(" as ")[0]):
            yield path, name


def test_all_that_users_are_shown_is_among_the_public_import_paths():
    text = (ROOT / "docs/plugins.md").read_text(encoding="utf-8")
    table = text.partition("## Import paths that stay")[2].partition("\n## ")[0]
    public = {
        (path, name)
        for path, cell in re.findall(
            r"^\| `((?:madns_runtime|cosmos_cli)[\w.]*)` \| (.*) \|$", table, re.MULTILINE
        )
        for name in re.findall(r"`(\w+)`", cell)
    }
    shown = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "scenarios").rglob("*.py")]
    shown += [path for path in (ROOT / "cosmos_cli/templates").rglob("*") if path.suffix == ".py"]
    used = {pair for path in shown for pair in imported_by(path.read_text(encoding="utf-8"))}

    assert len(used) > 10
    assert used - public == set()


@pytest.mark.parametrize("package", PACKAGES)
def test_every_room_stands_in_the_map_of_the_house_and_nothing_lies_loose_beside_it(package):
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    table = text.partition(f"| room of `{package}/` |")[2].partition("\n\n")[0]
    shown = set(
        re.findall(r"`([\w.]+/?)`", "\n".join(re.findall(r"^\| (.*?) \|", table, re.MULTILINE)))
    )
    found = {
        f"{path.name}/" if path.is_dir() else path.name
        for path in (ROOT / package).iterdir()
        if path.suffix == ".py" or (path / "__init__.py").exists()
    }

    assert found - {"__init__.py"} == shown


def late_imports(file):
    """Yield (line, whether a comment at it or above it tells why) of each import inside a function."""
    lines = file.read_text(encoding="utf-8").split("\n")
    functions = ast.FunctionDef | ast.AsyncFunctionDef
    inside = {
        node
        for function in ast.walk(tree_of(file))
        if isinstance(function, functions)
        for node in ast.walk(function)
        if isinstance(node, ast.Import | ast.ImportFrom)
    }
    for node in inside:
        first = node.lineno - 1
        while lines[first - 1].strip().startswith(("import ", "from ", "with IMPORT_TURN:")):
            first -= 1
        told = lines[first : node.end_lineno]
        has_reason = any("#" in line for line in told) or lines[first - 1].strip().startswith("#")
        yield node.lineno, has_reason


def test_imports_inside_functions_are_few_and_say_why():
    found = [
        (str(file.relative_to(ROOT)), line, has_reason)
        for file in FILES
        for line, has_reason in late_imports(file)
    ]

    assert [(file, line) for file, line, has_reason in found if not has_reason] == []
    assert 0 < len(found) <= LATE_IMPORTS_MAX


def test_the_operators_imports_inside_functions_take_turns():
    """Boards' programs import with one thread, and the entry point before there are others."""
    alone = ("cosmos_cli/onboard/", "cosmos_cli/start.py")
    found, in_turn = [], set()
    for file in FILES:
        name = str(file.relative_to(ROOT))
        if not name.startswith("cosmos_cli/") or name.startswith(alone):
            continue
        found += [(name, line) for line, _ in late_imports(file)]
        in_turn |= {
            (name, inner.lineno)
            for node in ast.walk(tree_of(file))
            if isinstance(node, ast.With) and ast.unparse(node.items[0]) == "IMPORT_TURN"
            for inner in node.body
        }

    assert len(found) > 10
    assert [place for place in found if place not in in_turn] == []


def test_operators_side_names_no_shipped_simulation():
    """Templates are what `init` copies; a descriptor, or the run's own record, tells the others all they know."""
    named = [
        f"{path.relative_to(ROOT)}:{number}"
        for path in sorted((ROOT / "cosmos_cli").rglob("*.py"))
        if "templates" not in path.parts and path.name != "init.py"
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if re.search(r"\b(counter|constellation)\b", line)
    ]

    assert named == []


def test_files_of_tests_have_names_of_their_own():
    """Two modules of one name cannot be collected together, but in packages; each folder alone would pass."""
    places = defaultdict(list)
    for path in sorted((ROOT / "tests").rglob("*.py")):
        is_elsewhere = "inside" in path.parts  # what a guest system collects by itself
        if not is_elsewhere and not (path.parent / "__init__.py").exists():
            places[path.name].append(str(path.relative_to(ROOT)))
    del places["conftest.py"]

    assert len(places) > 200
    assert {name: found for name, found in places.items() if len(found) > 1} == {}
