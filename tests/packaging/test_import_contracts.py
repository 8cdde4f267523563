"""The import contracts must name what they are about: a module that is left out is bound by nothing."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
CONTRACTS = {
    contract["name"]: contract
    for contract in tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"][
        "contracts"
    ]
}


def modules_below(package):
    folder = ROOT / package
    found = (path for path in folder.iterdir() if path.suffix == ".py" or path.is_dir())
    names = {path.stem for path in found if not path.name.startswith("__")}
    return {f"{package}.{name}" for name in names}


def test_every_module_of_the_framework_may_not_know_a_simulation():
    named = set(CONTRACTS["The framework knows no simulation"]["source_modules"])

    assert modules_below("madns_runtime") - {"madns_runtime.simulations"} == named


def test_pure_modules_of_the_operators_side_are_held_to_it():
    name = "Pure modules touch no socket, clock, thread, file system or chance"

    assert {"cosmos_cli.launch.plan", "cosmos_cli.launch.feasibility"} <= set(
        CONTRACTS[name]["source_modules"]
    )
