"""A rerun of a simulation that a distribution installs: no run keeps a copy of it, and its version is on record."""

import json
import shutil
import sys

import pytest

from cosmos_cli import app
from cosmos_cli.rerun.flown_software import installed_remarks
from madns_runtime.plugin.entry_points import distributions_of
from madns_runtime.plugin.registry import GROUP

MODULE = """
from dataclasses import dataclass
from madns_runtime.plugin.api import AgentSimulation, DeclaredStream, Simulation
from madns_runtime.recording.records import Field

FIELDS = (Field("tick", "", "int"), Field("x", "m"))


@dataclass(frozen=True)
class Parameters:
    pass


class Agent(AgentSimulation):
    def setup(self, context, initial):
        self.context = context
        context.open_stream("path", FIELDS)

    def step(self, tick):
        self.context.record("path", (tick.index, 1.0 * tick.index))


def streams(parameters, agents):
    return [DeclaredStream(role="agent", name="path", fields=FIELDS)]


simulation = Simulation(
    name="kites", parameters=Parameters, agent="kites_sim:Agent", streams="kites_sim:streams"
)
"""
SCENARIO = """
name: kites
simulation: kites
agents: {count: 1}
time: {mode: lockstep, duration_s: 1}
"""


def install(site, version, *, old=None):
    """Put the distribution kites into a folder of packages, as pip does."""
    if old is not None:
        shutil.rmtree(site / f"kites-{old}.dist-info")
    info = site / f"kites-{version}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: kites\nVersion: {version}\n")
    (info / "entry_points.txt").write_text("[madns.simulations]\nkites = kites_sim:simulation\n")
    (site / "kites_sim.py").write_text(MODULE)


@pytest.mark.process
def test_what_a_distribution_installs_is_flown_as_it_is_today_and_told(
    tmp_path, monkeypatch, capsys
):
    site, folder = tmp_path / "site", tmp_path / "scenario"
    install(site, "1.0")
    monkeypatch.setenv("PYTHONPATH", str(site))
    monkeypatch.setattr(sys, "path", [*sys.path, str(site)])
    monkeypatch.setenv("COSMOS_RUNS", str(tmp_path / "runs"))
    monkeypatch.setenv("COSMOS_CACHE", str(tmp_path / "cache"))
    folder.mkdir()
    (folder / "kites.yaml").write_text(SCENARIO)
    assert app.run(["run", str(folder / "kites.yaml"), "--quiet", "--no-report", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["versions"]["kites"] == "1.0"
    # As a second installation within one process does: entry points are read once per path of imports.
    (tmp_path / "later").symlink_to(site)
    monkeypatch.setattr(sys, "path", [str(tmp_path / "later"), *sys.path[:-1]])
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "later"))
    install(site, "1.1", old="1.0")

    assert app.run(["rerun", "last", "--as-recorded", "--quiet", "--json"]) == 0

    remarks = json.loads(capsys.readouterr().out)["remarks"]
    assert "kites is 1.1, was 1.0" in remarks
    assert any(text.startswith("the simulation kites is a package that is") for text in remarks)


def test_shipped_simulations_and_files_of_the_scenarios_folder_are_no_packages_of_others():
    assert installed_remarks("constellation") == ()
    assert installed_remarks("./rover.py:simulation") == ()


@pytest.mark.parametrize("is_registered", [True, False])
def test_the_version_of_a_simulation_that_is_named_by_its_place_is_on_record(
    tmp_path, monkeypatch, is_registered
):
    install(tmp_path, "1.0")
    info = tmp_path / "kites-1.0.dist-info"
    if not is_registered:
        (info / "entry_points.txt").unlink()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: kites_sim\nVersion: 1.0\n")
        info.rename(tmp_path / "kites_sim-1.0.dist-info")
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    name = "kites" if is_registered else "kites_sim"

    assert distributions_of(GROUP, "kites_sim:simulation") == {name: "1.0"}
    assert distributions_of(GROUP, "kites_sim.part:other") == {name: "1.0"}
    assert distributions_of(GROUP, "./kites_sim.py:simulation") == {}
    assert distributions_of(GROUP, "no_such_module:simulation") == {}
