"""Devices whose kind no rerun can ask are played back so that all that was read of them can be; a simulation that is gone is told."""

import json
from dataclasses import replace

import pytest

from cosmos_cli.errors import InputError
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.rerun.recorded_run import FlownRun, RecordedAgent, UsedDevice
from cosmos_cli.rerun.scenario import make_rerun
from madns_runtime.config import Agents, RunConfig, TimeSettings, to_mapping

JOYSTICK = (
    '{"schema":1,"stream":"joystick","shape":"array","fields":['
    '{"name":"t_s","unit":"s","kind":"float"},{"name":"number","unit":"","kind":"int"},'
    '{"name":"age_us","unit":"us","kind":"int"},'
    '{"name":"joystick_direction","unit":"","kind":"float"},'
    '{"name":"joystick_action","unit":"","kind":"float"}]}\n[0.1,1,0,1.0,0.0]\n'
)


def test_inputs_of_an_inventorys_device_can_be_taken_as_queues(tmp_path):
    folder = tmp_path / "devices" / "pi22" / "sense"
    folder.mkdir(parents=True)
    (folder / "joystick.jsonl").write_text(JOYSTICK)
    used = UsedDevice(
        agent="agent-01", name="sense", full_name="pi22/sense", folder=folder, may_write=True
    )
    config = RunConfig(
        run="0001-r",
        scenario="r",
        simulation="counter",
        base_directory=str(tmp_path),
        agents=Agents(count=1, tick_hz=10.0),
        time=TimeSettings(duration_s=1.0),
    )
    agents = {"agent-01": RecordedAgent(ticks=None, last_s=0.9)}
    run = FlownRun(run=RunDirectory(tmp_path), config=config, agents=agents, devices=(used,))

    (device,) = make_rerun(run).scenario.scenario.hardware.devices

    assert device.parameters["queues"] == ["joystick"]


@pytest.mark.process
def test_a_simulation_whose_file_is_gone_is_told_with_the_copy_that_can_fly(tmp_path):
    run = RunDirectory(tmp_path / "0001-r")
    run.path.mkdir()
    config = RunConfig(
        run="0001-r",
        scenario="r",
        simulation="./rover.py:simulation",
        base_directory=str(tmp_path),
        agents=Agents(count=1, tick_hz=10.0),
        time=TimeSettings(duration_s=1.0, mode="lockstep"),
    )
    run.plan_json.write_text(json.dumps({"config": to_mapping(config)}))
    today = FlownRun(run=run, config=config, agents={}, devices=())
    elsewhere = replace(today, config=replace(config, base_directory=str(tmp_path / "copy")))

    gone = r"^0001-r cannot be flown again: \./rover\.py:simulation: no file [^;]*"
    with pytest.raises(InputError, match=f"{gone}; where .* own copy with --as-recorded$"):
        make_rerun(today)
    with pytest.raises(InputError, match=f"{gone}$"):
        make_rerun(elsewhere)
