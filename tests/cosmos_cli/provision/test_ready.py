"""A machine is made ready for a run within a moment: looked at, and sent what is quick to send."""

import os
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
from made_wheels import make_runtime_wheels, make_wheel, only_index
from onboard_machine import OwnMachine

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.models.inventory import Machine, Variables
from cosmos_cli.models.loading import load_scenario
from cosmos_cli.provision import before_run
from cosmos_cli.provision.before_run import Cargo, cargo_of, make_ready
from cosmos_cli.provision.environment import install_environment
from cosmos_cli.provision.platform import greeted_platform
from cosmos_cli.provision.wheelhouse import prepare
from cosmos_cli.ui import invocation
from cosmos_cli.ui.invocation import Invocation

pytestmark = pytest.mark.process

SCENARIO = """
name: small
simulation: counter
agents: {count: 2, tick_hz: 10}
requirements: [navlib]
"""


@pytest.fixture
def machine(tmp_path):
    return OwnMachine(tmp_path / "root")


@pytest.fixture
def scenario(tmp_path):
    folder = tmp_path / "scenario"
    folder.mkdir()
    (folder / "small.yaml").write_text(SCENARIO)
    (folder / "flight.py").write_text("gain = 1\n")
    return load_scenario(folder / "small.yaml")


@pytest.fixture(scope="module")
def made_index(tmp_path_factory):
    """A folder of wheels for this computer; what is resolved from it is remembered for all of these tests."""
    folder = tmp_path_factory.mktemp("ready")
    with OwnMachine(folder / "root").board() as board:
        platform = greeted_platform(board.greeting)
    digits = "".join(map(str, platform.python))
    make_runtime_wheels(folder / "index", digits, machines=[platform.machine])
    for name in ("navlib", "maplib", "scipy", "sgp4"):
        make_wheel(folder / "index", name)
    return folder


@pytest.fixture
def index(made_index, monkeypatch):
    only_index(monkeypatch, made_index, made_index / "index")


def installed(machine, *requirements, **how):
    """Do what `cosmos up` does."""
    with machine.board() as board:
        environment = prepare(greeted_platform(board.greeting), requirements, **how)
        install_environment(board, machine.layout, environment)
    machine.calls.clear()
    return environment


def ready(machine, scenario, /, **how):
    with machine.board() as board:
        cargo = scenario if isinstance(scenario, Cargo) else cargo_of(scenario)
        return make_ready(board, how.pop("target", machine.target), cargo, **how)


def test_programs_are_told_where_everything_is(machine, index, scenario):
    environment = installed(machine, "navlib")

    made = ready(machine, scenario)

    assert made.python == machine.layout.python(environment.key)
    assert (Path(made.python_path) / "madns_runtime/agent.py").is_file()
    assert (Path(made.base_directory) / "small.yaml").read_text() == SCENARIO
    assert all(os.path.isabs(p) for p in (made.python, made.python_path, made.base_directory))
    assert made.variables()["PYTHONPATH"] == made.python_path
    assert made.variables()["COSMOS_BASE_DIRECTORY"] == made.base_directory


def test_missing_environment_names_the_command_that_makes_it(machine, index, scenario):
    with pytest.raises(MachineFailure) as caught:
        ready(machine, scenario)

    assert caught.value.kind is FailureKind.STEP
    assert f"cosmos up -i INVENTORY {scenario.path}" in caught.value.advice
    assert not Path(machine.layout.trees).exists()


def test_command_that_makes_it_is_told_with_the_inventory_that_was_given(
    machine, index, scenario, monkeypatch
):
    words = ("-qi", "my box.yaml", "--limit=pi01", str(scenario.path))
    given = Invocation(verb="run", words=words, valued=frozenset({"-i", "--limit"}))
    monkeypatch.setattr(invocation, "current", lambda: given)

    with pytest.raises(MachineFailure) as caught:
        ready(machine, scenario)

    up = f"cosmos up -i 'my box.yaml' --limit pi01 {scenario.path}"
    assert f"run `{up}` first" in caught.value.advice


def test_environment_without_the_scenarios_requirements_is_not_enough(machine, index, scenario):
    installed(machine)

    with pytest.raises(MachineFailure, match="cosmos up"):
        ready(machine, scenario)


def test_damaged_environment_is_not_run_in(machine, index, scenario):
    environment = installed(machine, "navlib")
    site = next(Path(machine.layout.environment(environment.key)).rglob("numpy"))
    (site / "__init__.py").write_text("")

    with pytest.raises(MachineFailure, match="cosmos up"):
        ready(machine, scenario)


def test_machines_own_requirements_and_packages_count(machine, index, scenario):
    given = {"cosmos_requirements": ["maplib"], "cosmos_packages": ["python3-rtimulib"]}
    entry = Machine(name="own", address="own", variables=Variables.of(given))
    environment = installed(machine, "maplib", "navlib", sees_system=True)

    assert environment.key in ready(machine, scenario, machine=entry).python


@pytest.mark.nightly
def test_host_machine_needs_more(machine, index, scenario):
    installed(machine, "navlib")
    with pytest.raises(MachineFailure):
        ready(machine, scenario, is_host=True)
    environment = installed(machine, "navlib", is_host=True)

    assert environment.key in ready(machine, scenario, is_host=True).python


def test_second_time_only_looks(machine, index, scenario):
    installed(machine, "navlib")
    first = ready(machine, scenario)
    machine.calls.clear()

    assert ready(machine, scenario) == first
    assert [verb for verb, _, _ in machine.calls] == ["installed"]


def test_edited_flight_software_needs_no_up(machine, index, scenario):
    installed(machine, "navlib")
    first = ready(machine, scenario)
    (scenario.base_directory / "flight.py").write_text("gain = 2\n")

    second = ready(machine, scenario)

    assert (Path(second.base_directory) / "flight.py").read_text() == "gain = 2\n"
    assert (Path(first.base_directory) / "flight.py").read_text() == "gain = 1\n"


def test_full_disk_names_the_command_that_makes_room(machine, index, scenario, monkeypatch):
    def refuse(*_):
        raise MachineFailure(FailureKind.DISK_FULL, "No space left on device", "make room there")

    installed(machine, "navlib")
    monkeypatch.setattr(before_run, "send_tree", refuse)
    with pytest.raises(MachineFailure) as caught:
        ready(machine, scenario)

    assert caught.value.kind is FailureKind.DISK_FULL
    assert f"`cosmos up -i INVENTORY {scenario.path}`, which removes" in caught.value.advice


def test_all_machines_of_a_run_get_the_files_as_they_were_at_its_start(machine, index, scenario):
    installed(machine, "navlib")
    cargo = cargo_of(scenario)
    first = ready(machine, cargo)
    (scenario.base_directory / "flight.py").write_text("gain = 2\n")

    assert ready(machine, cargo) == first


def test_tilde_is_the_home_of_who_logs_in(machine, index, scenario, monkeypatch, tmp_path):
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.setenv("HOME", str(home))
    target = replace(machine.target, root="~/cosmos")
    there = OwnMachine(home / "cosmos")
    installed(there, "navlib")

    made = ready(machine, scenario, target=target)

    assert made.python.startswith(f"{home}/cosmos/environments/")
    assert Path(made.base_directory).is_dir()


def test_interpreter_runs_with_these_variables(machine, index, scenario):
    installed(machine, "navlib")
    made = ready(machine, scenario)

    program = "import madns_runtime, navlib; print(madns_runtime.__file__, navlib.__file__)"
    done = subprocess.run(
        [made.python, "-c", program],
        env=made.variables(),
        cwd="/",
        capture_output=True,
        text=True,
        check=True,
    )

    runtime, navlib = done.stdout.split()
    assert runtime.startswith(made.python_path)
    assert navlib.startswith(str(Path(made.python).parents[1]))
