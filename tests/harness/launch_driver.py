"""
Runs the operator's loop, or the whole command line, over fake children, as a process of its own.

    launch_driver.py operator DIRECTORY    prints the outcome as JSON
    launch_driver.py cosmos ARGUMENT...    as `cosmos ARGUMENT...`

COSMOS_CONSTANTS shortens waits: {"host_limits.MARGIN_S": 1, ...} of modules in cosmos_cli.launch.
"""

from __future__ import annotations

import dataclasses
import importlib
import json
import os
import sys
from pathlib import Path

from cosmos_cli.launch import child
from madns_runtime.config import Agents, RunConfig, Timeouts

FAKE_CHILD = str(Path(__file__).with_name("launch_fake_child.py"))


def patch() -> None:
    child.HOST_PROGRAM = (sys.executable, FAKE_CHILD, "host")
    child.AGENT_PROGRAM = (sys.executable, FAKE_CHILD, "agents")
    for dotted, value in json.loads(os.environ.get("COSMOS_CONSTANTS", "{}")).items():
        module, name = dotted.split(".")
        target = importlib.import_module(f"cosmos_cli.launch.{module}")
        assert hasattr(target, name), dotted
        setattr(target, name, value)


def run_operator(directory: Path) -> None:
    import time

    from cosmos_cli.launch.operator import Operator
    from cosmos_cli.launch.request import LaunchRequest, with_manual_agents
    from cosmos_cli.launch.signals import OperatorSignals
    from cosmos_cli.view.plain import PlainView

    manual = tuple(filter(None, os.environ.get("COSMOS_MANUAL", "").split(",")))
    config = RunConfig(
        run="0001-fake",
        scenario="fake",
        simulation="counter",
        base_directory=".",
        agents=Agents(count=2),
        timeouts=Timeouts(**json.loads(os.environ["COSMOS_TIMEOUTS"])),
    )
    config = with_manual_agents(config, manual)
    request = LaunchRequest(
        config=config,
        directory=directory,
        machines={"loopback": config.agents.resolved_names()},
        manual=manual,
        run_key_hex=os.environ["COSMOS_TEST_KEY_REVERSED"][::-1],
    )
    with OperatorSignals() as signals:
        view = PlainView(sys.stderr, config.time.duration_s, now_s=time.monotonic)
        outcome = Operator(request, view, signals).run()
    sys.stdout.write(json.dumps(dataclasses.asdict(outcome)))
    try:
        sys.stderr.flush()
    except OSError:  # nobody hears it any more; the interpreter's own end would fail at it again
        sys.stderr = None


if __name__ == "__main__":
    patch()
    if sys.argv[1] == "operator":
        run_operator(Path(sys.argv[2]))
    else:
        from cosmos_cli.app import main

        main(sys.argv[2:])
