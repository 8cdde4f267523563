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


def test_pure_modules_of_the_operators_side_are_held_to_it():
    name = "Pure modules touch no socket, clock, thread, file system or chance"

    assert {"cosmos_cli.launch.plan", "cosmos_cli.launch.feasibility"} <= set(
        CONTRACTS[name]["source_modules"]
    )
