"""Devices that are driven without a run, in a process of its own on this computer."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from cosmos_cli.errors import InputError, MachinesError
from cosmos_cli.launch.device_needs import missing_here
from cosmos_cli.models.device_kinds import DeviceQuestion, KindAnswer, ask_kinds
from cosmos_cli.models.inventory import Machine
from cosmos_cli.models.inventory.devices import MachineDevice, driven_devices
from cosmos_cli.system.bounded_process import describe_exit, run_bounded
from cosmos_cli.ui.foreign_text import clean_text
from madns_runtime.config import DeviceLaunch, Timeouts, to_mapping

PROGRAM = (sys.executable, "-P", "-m", "madns_runtime.hardware.sampling")
END_S = 15.0
"""Time beyond its seconds, for the program to start and for devices to be made safe and closed."""
USER = "cosmos-devices"
TALK_SHOWN_MAX = 2000


def _ask_kind(machine: Machine, device: MachineDevice) -> KindAnswer:
    """Ask a device's kind about its parameters."""
    question = DeviceQuestion(
        path=(),
        kind=device.kind,
        parameters=device.parameters,
        base_directory=machine.devices_folder,
    )
    (answer,) = ask_kinds([question])
    return answer


def missing_for(machine: Machine, device: MachineDevice) -> list[str]:
    """Return what a device of this computer needs and is not here, each with its cure."""
    answer = _ask_kind(machine, device)
    if answer.faults:  # its needs are not known then
        return [f"{answer.faults[0].text}: mend it in the inventory"]
    return list(missing_here(answer.needs))


def launch_of(machine: Machine, device: MachineDevice, *, writes: bool) -> DeviceLaunch:
    """
    Return what drives one device of a machine.

    Args:
        machine: Which.
        device: As its inventory lists it.
        writes: Whether outputs may be written, where the inventory permits it.

    Raises:
        InputError: Its kind refuses its parameters.
    """
    answer = _ask_kind(machine, device)
    if answer.faults:
        raise InputError(f"{machine.name}/{device.name}: {answer.faults[0].text}")
    return DeviceLaunch(
        name=device.name,
        place=machine.name,
        kind=device.kind,
        base_directory=str(machine.devices_folder),
        rate_hz=device.rate_hz or answer.rate_hz,
        parameters=device.parameters,
        serial=device.serial,
        users=(USER,),
        owner=USER,
        may_move=writes and device.outputs,
        why_not="" if writes and device.outputs else "nobody asked for it",
        hang_s=device.hang_s,
        frozen_s=device.frozen_s,
    )


def chosen_devices(
    machines: Sequence[Machine], name: str | None
) -> list[tuple[Machine, MachineDevice]]:
    """
    Return the devices that a name means, such as imu or pi22/imu; all of them for None.

    Raises:
        InputError: There is none.
    """
    there = [
        (machine, device)
        for machine in machines
        for device in driven_devices(machine.variables.cosmos_devices or ()).values()
    ]
    found = [
        (machine, device)
        for machine, device in there
        if name in (None, device.name, f"{machine.name}/{device.name}")
    ]
    if not found:
        known = ", ".join(f"{machine.name}/{device.name}" for machine, device in there)
        wanted = f"no device {name!r}" if name else "no device that can be driven"
        raise InputError(f"{wanted} in the inventory; there are {known or 'none'}")
    return found


def sample_here(
    launches: Sequence[DeviceLaunch],
    seconds: float,
    directory: Path,
    *,
    writes: bool = False,
    say: Callable[[str], None],
) -> dict[str, Any]:
    """
    Drive devices of this computer for some seconds, and return what each gave, by full name.

    Args:
        launches: The devices.
        seconds: How long.
        directory: Where records go.
        writes: Whether outputs that may move are written their safe values.
        say: Told what drivers print.

    Raises:
        MachinesError: The process that drives them failed, or did not come to an end.
    """
    # Its other end is closed with this process, however that ends: nobody else ends a session of its own.
    lifeline, our_end = os.pipe()
    order = {
        "devices": [to_mapping(launch) for launch in launches],
        "seconds": seconds,
        "directory": str(directory),
        "writes": writes,
        "lifeline": lifeline,
    }
    limit_s = seconds + END_S + Timeouts().loading_s
    try:
        done = run_bounded(
            PROGRAM,
            timeout_s=limit_s,
            stdin=json.dumps(order) + "\n",
            environment=os.environ,
            pass_fds=(lifeline,),
        )
    except subprocess.TimeoutExpired:
        raise MachinesError(
            f"the process that drives {', '.join(each.full_name for each in launches)} did not end within"
            f" {limit_s:g} s and was killed: look at its driver and its device"
        ) from None
    finally:
        os.close(lifeline)
        os.close(our_end)
    try:
        told: dict[str, Any] = json.loads(done.stdout)
    except ValueError:
        last = clean_text(done.stderr[-TALK_SHOWN_MAX:]).strip()
        raise MachinesError(
            f"the process that drives them {describe_exit(done.returncode)}: {last or 'without a word'}"
        ) from None
    if "error" in told:
        raise MachinesError(str(told["error"]))
    if talk := clean_text(done.stderr[-TALK_SHOWN_MAX:]).strip():
        say(talk)
    devices: dict[str, Any] = told["devices"]
    return devices


def record(
    launch: DeviceLaunch, seconds: float, directory: Path, sample: Callable[[Path], dict[str, Any]]
) -> dict[str, Any]:
    """
    Record a device into a folder that the kind `playback` plays, and return what it gave.

    Args:
        launch: The device.
        seconds: How long.
        directory: The folder; it is made.
        sample: Samples the device with its records below a given folder, and returns what it gave, by full name.

    Raises:
        InputError: The folder is there already, or cannot be made.
        MachinesError: As of *sample*; or there was no sample, and then no folder is left.
    """
    if directory.exists():
        raise InputError(f"{directory}: is there already; name a new folder")
    try:
        directory.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix=".cosmos-devices-", dir=directory.parent))
    except OSError as error:
        raise InputError(f"{directory}: cannot write there: {error.strerror or error}") from error
    try:
        told: dict[str, Any] = sample(folder)[launch.full_name]
        if not any(channel.get("samples") for channel in told["channels"].values()):
            why = told["error"] or told["why"] or "it gave none"
            raise MachinesError(f"{launch.full_name}: no sample in {seconds:g} s: {why}")
        os.rename(folder / "devices" / launch.place / launch.name, directory)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return told
