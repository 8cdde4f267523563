"""What `validate` and `plan` say of a plug-in file that is faulty: file and line, and 2."""

import json
import sys

import pytest

from cosmos_cli import app

pytestmark = pytest.mark.process

PLUGIN = """\
from dataclasses import dataclass
from madns_runtime.plugin.api import AgentSimulation, Simulation
@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters:
    gain: float = 2.0
class Agent(AgentSimulation):
    pass
def check(parameters, agents, base_directory):
    return []
simulation = Simulation(
    name="p", parameters=Parameters, agent=":Agent", check=":check", demand=":check"
)
"""
SCENARIO = "name: a\nsimulation: ./p.py:simulation\nagents: {count: 3}\n"


@pytest.fixture
def cosmos(tmp_path, monkeypatch, capfd):
    """Return a function that writes the plug-in, and runs a command on its scenario."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("COSMOS_DEBUG", raising=False)
    (tmp_path / "a.yaml").write_text(SCENARIO)

    def run(plugin, verb, *arguments):
        (tmp_path / "p.py").write_text(plugin)
        code = app.run([verb, "a.yaml", *arguments])
        captured = capfd.readouterr()
        return code, captured.out, captured.err

    yield run
    for name in [
        n for n, m in sys.modules.items() if str(tmp_path) in str(vars(m).get("__file__"))
    ]:
        del sys.modules[name]


@pytest.mark.parametrize("verb", ["validate", "run", "plan"])
def test_plugin_that_ends_the_process_ends_the_command_with_2(cosmos, verb, tmp_path):
    code, out, err = cosmos("import sys\nsys.exit(0)\n", verb)

    assert (code, out) == (2, "")
    assert f"{tmp_path / 'p.py'}:2: it called sys.exit(0)" in err


def test_json_is_not_spoilt_by_what_a_plugin_prints(cosmos):
    code, out, err = cosmos("print('hello')\n" + PLUGIN, "validate", "--json")

    assert (code, json.loads(out)["valid"]) == (0, True)
    assert "hello" in err


@pytest.mark.parametrize("value", ["1 / 0", "None", "3"])
def test_faulty_check_is_a_fault_of_the_plugin(cosmos, value, tmp_path):
    code, _, err = cosmos(PLUGIN.replace("return []", f"return {value}"), "validate")

    assert code == 2
    assert err.startswith(f"a.yaml:2:13: simulation: {tmp_path / 'p.py'}:")
    assert "check()" in err
    assert "defect of COSMoS" not in err


def test_faulty_demand_is_a_fault_of_the_plugin(cosmos, tmp_path):
    code, _, err = cosmos(PLUGIN.replace("agents, base_directory", "agents, *_"), "plan")

    assert code == 2
    assert f"{tmp_path / 'p.py'}:8: demand() must return" in err
    assert "defect of COSMoS" not in err


def test_parameters_class_that_raises_is_a_fault_of_the_plugin(cosmos, tmp_path):
    more = "    gain: float = 2.0\n    def __post_init__(self):\n        1 / 0\n"

    code, _, err = cosmos(PLUGIN.replace("    gain: float = 2.0\n", more), "validate")

    assert code == 2
    assert f"{tmp_path / 'p.py'}:7: Parameters: ZeroDivisionError: division by zero" in err


def test_class_that_is_not_there_is_found_before_a_run(cosmos, tmp_path):
    code, _, err = cosmos(PLUGIN.replace('":Agent"', '":Agnt"'), "validate")

    assert code == 2
    assert f"{tmp_path / 'p.py'}:11: Agnt: there is no 'Agnt', did you mean Agent?" in err
    assert "madns_plugin_" not in err
