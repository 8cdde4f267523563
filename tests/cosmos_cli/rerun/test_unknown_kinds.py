"""Devices whose kind no rerun can ask, such as those of an inventory, are played back so that all that was read of them can be."""

from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.rerun.recorded_run import FlownRun, RecordedAgent, UsedDevice
from cosmos_cli.rerun.scenario import make_rerun
from madns_runtime.config import Agents, RunConfig, TimeSettings

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
