"""A rehearsal names what mends each obstacle, in words that can be copied."""

import shlex
from types import SimpleNamespace

from cosmos_cli.commands.command_group import load_command
from cosmos_cli.launch.rehearsal import MachineRehearsal
from cosmos_cli.ui import invocation


def test_room_is_made_by_commands_that_can_be_copied():
    words = ("-i", "my tower.yaml", "-i", "lab.yaml", "--limit", "tower", "s.yaml")
    invocation.record("run", words, frozenset({"-i", "--limit"}), has_tail=False)
    disk = SimpleNamespace(is_read_only=False, is_writable=True, is_noexec=False, free_bytes=0)
    machine = MachineRehearsal(
        identity=("boot", "pi01", "/home/pi/cosmos"),
        agents=1,
        is_host=False,
        opening_ms=1.0,
        facts=SimpleNamespace(disk=disk),
        has_environment=True,
        files_missing=0,
        bytes_missing=0,
        is_udp_tried=False,
    )

    (obstacle,) = machine.obstacles("pi01", "cosmos up")

    told = {}
    for advice in obstacle.cure.split("`")[1::2]:
        _, verb, *advised = shlex.split(advice)
        told[verb] = load_command(verb).make_context(verb, advised).params
    assert told["collect"]["run"] == "RUN"
    assert told["wipe"]["inventory"] == ("my tower.yaml", "lab.yaml")
    assert told["wipe"]["limit"] == "pi01"
