"""What import contracts cannot hold: that they name what they are about, and that pure modules call nothing impure."""

import ast
import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
CONTRACTS = {
    contract["name"]: contract
    for contract in tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"][
        "contracts"
    ]
}
PURITY = CONTRACTS["Pure modules touch no socket, clock, thread, file system or chance"]
IMPURE_MODULES = set(PURITY["forbidden_modules"])
IMPURE_METHODS = re.compile(
    r"exists|glob|is_dir|is_file|iterdir|mkdir|read_bytes|read_text|rglob|stat|touch|unlink|write_bytes|write_text"
    r"|now|today|utcnow"
)
TOUCHES_NOTHING = {"gaierror"}
"""Names of impure modules that a pure one may know: errors."""
SAYS_PURE = re.compile(r"\bPure\b(?! but for)")


def test_pure_modules_of_the_operators_side_are_held_to_it():
    assert {"cosmos_cli.launch.plan", "cosmos_cli.launch.feasibility"} <= set(
        PURITY["source_modules"]
    )


def pure_modules():
    """Yield the file and tree of each module that the contract names, or that calls itself pure."""
    named = [ROOT.joinpath(*module.split(".")) for module in PURITY["source_modules"]]
    for package in ("cosmos_cli", "madns_runtime"):
        for file in sorted((ROOT / package).rglob("*.py")):
            text = file.read_text(encoding="utf-8")
            is_named = any(path == file.with_suffix("") or path in file.parents for path in named)
            if is_named or ("Pure" in text and "templates" not in file.parts):
                tree = ast.parse(text)
                if is_named or SAYS_PURE.search(ast.get_docstring(tree) or ""):
                    yield file, tree


def impurities(tree):
    """Yield the line and the text of all that reaches for files, clocks, chance or other processes by itself."""
    for node in ast.walk(tree):
        match node:
            case ast.Import(names=names):
                is_impure = any(name.name.split(".")[0] in IMPURE_MODULES for name in names)
            case ast.ImportFrom(module=str(module), names=names):
                taken = {name.name for name in names} - TOUCHES_NOTHING
                is_impure = bool(taken) and module.split(".")[0] in IMPURE_MODULES
            case ast.Call(func=ast.Name(id="default_rng") | ast.Attribute(attr="default_rng")):
                is_impure = not (node.args or node.keywords)  # a seed makes it a function
            case ast.Call(func=ast.Name(id=name)):
                is_impure = name in ("open", "input", "print")
            case ast.Call(func=ast.Attribute(attr=name)):
                is_impure = IMPURE_METHODS.fullmatch(name) is not None
            case _:
                continue
        if is_impure:
            yield node.lineno, ast.unparse(node)


def test_what_is_impure_is_found():
    text = """
import subprocess
from time import monotonic
from socket import gaierror
NOW = datetime.now(UTC)
TEXT = Path("x").read_text()
with open("y") as file: pass
CHANCE = np.random.default_rng()
SAME = np.random.default_rng(seed)
"""

    assert [line for line, _ in sorted(impurities(ast.parse(text)))] == [2, 3, 5, 6, 7, 8]


def test_pure_modules_reach_for_nothing_by_themselves():
    """Also those that no contract names but their own docstring. What they are given may: who reads its table knows."""
    found = {str(file.relative_to(ROOT)): list(impurities(tree)) for file, tree in pure_modules()}

    assert len(found) > 200
    assert {name: impure for name, impure in found.items() if impure} == {}
