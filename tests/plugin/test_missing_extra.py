"""A plug-in whose library is missing: the command that installs it is that of its own distribution."""

import pytest

from cosmos_cli import app

PLUGIN = """
from dataclasses import dataclass

from madns_runtime.errors import MissingExtraError
from madns_runtime.plugin.api import AgentSimulation, Simulation


@dataclass(frozen=True, kw_only=True)
class Parameters:
    pass


class Rover(AgentSimulation):
    pass


def check(parameters, agents, base_directory):
    raise MissingExtraError("cv2", "vision"{of})


simulation = Simulation(name="rover", parameters=Parameters, agent=":Rover", check=":check")
"""
SCENARIO = "name: a\nsimulation: ./rover.py:simulation\nagents: {count: 1}\n"


@pytest.mark.process
@pytest.mark.parametrize(
    ("of", "told"), [(', "my-rovers"', "my-rovers[vision]"), ("", "cosmos-madns[vision]")]
)
def test_the_command_that_installs_what_is_missing_names_whose_extra_it_is(
    tmp_path, capsys, of, told
):
    (tmp_path / "rover.py").write_text(PLUGIN.replace("{of}", of))
    (tmp_path / "a.yaml").write_text(SCENARIO)

    assert app.run(["validate", str(tmp_path / "a.yaml")]) == 2
    assert f"cv2 is not installed here; install it with: pip install '{told}'" in (
        capsys.readouterr().err
    )
