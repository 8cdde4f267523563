"""Devices of other machines, driven without a run: each machine's in the environment that `cosmos up` made there."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from cosmos_cli.fleet.answers.verbs import malformed
from cosmos_cli.fleet.connection import Connection
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Answer, Helper
from cosmos_cli.fleet.layout import Layout, at_home
from cosmos_cli.fleet.liveness import SilenceWatch
from cosmos_cli.launch.device_sampling import END_S
from cosmos_cli.models.device_needs import needs_of_machines
from cosmos_cli.models.inventory import Machine
from cosmos_cli.provision import STORE_PARTS
from cosmos_cli.provision.before_run import DRIVERS_VARIABLE
from cosmos_cli.provision.driver_files import drivers_by_machine
from cosmos_cli.provision.environment import ask_installed, installed_request
from cosmos_cli.provision.trees import runtime_tree, send_tree
from cosmos_cli.provision.wheelhouse import EnvironmentNeed, remembered_key
from cosmos_cli.ui import invocation
from cosmos_cli.ui.foreign_text import clean_text
from madns_runtime.config import DeviceLaunch, Timeouts, to_mapping
from madns_runtime.plugin.registry import is_file

VERB: Final = "sample_devices"
PARTS: Final = (*STORE_PARTS, "device_sampling")
ANSWER_FILE: Final = "answer.json"
ANSWER_BYTES_MAX: Final = 4 * 1024 * 1024
RECORDS_BYTES_MAX: Final = 256 * 1024 * 1024
SIGN_TIMEOUT_S: Final = 30.0
"""For each sign of life, of which two come per second, or piece of a file."""
ENDING_S: Final = 30.0
"""For a program there that did not end to be ended, its devices safe, and for the last pieces."""
RECORD: Final = re.compile(r"devices/[\w.-]{1,128}/[\w.-]{1,128}/[\w.-]{1,128}\.jsonl")
WORDS_MAX: Final = 2000
ITEMS_MAX: Final = 10_000
REQUIRED: Final[Mapping[str, type | tuple[type, ...]]] = {
    "status": str,
    "identity": str,
    "error": str,
    "why": str,
    "errors": int,
    "lost": int,
    "channels": dict,
}


class MachineSampler:
    """
    Samples devices of machines; used by many threads.

    Args:
        machines: Those that have devices to sample.
        seconds: How long each is driven.
        writes: Whether outputs that may move are written their safe values.
        say: Told what drivers print.

    Raises:
        InputError: Drivers beside the inventory cannot be read.
    """

    def __init__(
        self,
        machines: Sequence[Machine],
        seconds: float,
        *,
        writes: bool = False,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._say = say
        self._seconds = seconds
        self._writes = writes
        self._needs = needs_of_machines(machines)
        self._drivers = drivers_by_machine(machines, self._needs.__getitem__)
        self._runtime = runtime_tree()

    def sample(
        self,
        connection: Connection,
        machine: Machine,
        launches: Sequence[DeviceLaunch],
        records: Path | None = None,
    ) -> dict[str, Any]:
        """
        Drive devices of one machine, and return what each gave, by full name.

        Args:
            connection: To the machine.
            machine: Its entry in the inventory.
            launches: Its devices.
            records: Folder here that their records are brought to; None to leave them.

        Raises:
            MachineFailure: It has no environment, what drives them failed or did not end in time, or it is lost.
        """
        with Helper.start(connection, PARTS, watch=SilenceWatch(connection)) as helper:
            asked = self._asked(helper, machine, launches) | {"has_records": records is not None}
            answers = helper.pieces(
                VERB, asked, timeout_s=SIGN_TIMEOUT_S, whole_s=asked["timeout_s"] + ENDING_S
            )
            told, said = read_answer(answers, records)
        if talk := clean_text(said).strip():
            self._say(f"{machine.name}: {talk}")
        if "error" in told:
            raise MachineFailure(FailureKind.STEP, str(_cleaned(told["error"])))
        return checked_devices(told, launches)

    def _asked(
        self, helper: Helper, machine: Machine, launches: Sequence[DeviceLaunch]
    ) -> dict[str, Any]:
        """Send what is quick to send, and return the arguments of the verb."""
        layout = Layout(at_home(machine.variables.root, str(helper.greeting["home"])))
        python = layout.python(self._environment(helper, machine, layout))
        drivers = self._drivers.get(machine.name)
        folder = drivers.directory(layout.tree(drivers.tree.hash)) if drivers else layout.root
        devices = [
            dataclasses.replace(each, base_directory=folder if is_file(each.kind) else layout.root)
            for each in launches
        ]
        return {
            "python": python,
            "variables": {
                "PYTHONPATH": layout.tree(self._runtime.hash),
                "PYTHONNOUSERSITE": "1",
                "COSMOS_STATE_DIR": layout.state,
                DRIVERS_VARIABLE: folder,
            },
            "directory": layout.state,
            "timeout_s": self._seconds + END_S + Timeouts().loading_s,
            "order": {
                "devices": [to_mapping(each) for each in devices],
                "seconds": self._seconds,
                "writes": self._writes,
            },
        }

    def _environment(self, helper: Helper, machine: Machine, layout: Layout) -> str:
        """Return the key of the environment that is there, and see that code is."""
        keys = [
            key
            for is_host in (False, True)
            if (
                key := remembered_key(
                    EnvironmentNeed.of_machine(
                        helper.greeting,
                        machine.variables,
                        (),
                        is_host=is_host,
                        needs=self._needs[machine.name],
                    )
                )
            )
        ]
        drivers = self._drivers.get(machine.name)
        trees = [self._runtime, *([drivers.tree] if drivers else [])]
        request = installed_request(
            layout, trees=[tree.hash for tree in trees], environments=keys, touch=bool(keys)
        )
        found = ask_installed(helper, request)
        key = next((key for key in keys if found.environments[key]), None)
        if key is None:
            raise MachineFailure(
                FailureKind.STEP,
                "the Python packages that its devices need are not installed there, or no longer whole",
                f"run `cosmos up{invocation.current().machine_options}` first",
            )
        for tree in trees:
            if not found.trees[tree.hash]:
                send_tree(helper, layout, tree)
        return key


def read_answer(answers: Iterator[Answer], records: Path | None) -> tuple[dict[str, Any], str]:
    """
    Return the program's answer and what drivers said, and write what it recorded below *records*.

    Raises:
        MachineFailure: DATA: it is none, files come that nobody asked for, or too much comes.
    """
    answer = bytearray()
    taken_bytes = 0
    said = ""
    for piece in answers:
        name = piece.value.get("file")
        said = piece.value.get("said", said)
        if name is None:
            continue
        taken_bytes += len(piece.body)
        if name == ANSWER_FILE:
            answer += piece.body
        elif records is None or not RECORD.fullmatch(name) or ".." in name:
            raise malformed(VERB, "a file that nobody asked for")
        else:
            path = records / name
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("ab") as file:
                file.write(piece.body)
        if len(answer) > ANSWER_BYTES_MAX or taken_bytes > RECORDS_BYTES_MAX + ANSWER_BYTES_MAX:
            raise malformed(VERB, "more than was asked for")
    try:
        told = json.loads(answer)
    except (ValueError, RecursionError):
        raise malformed(VERB, "no JSON") from None
    if not isinstance(told, dict):
        raise malformed(VERB, "no mapping")
    return told, said


def checked_devices(told: Mapping[str, Any], launches: Sequence[DeviceLaunch]) -> dict[str, Any]:
    """
    Return what is told of each device, with its texts cleaned.

    Raises:
        MachineFailure: DATA: something is missing.
    """
    try:
        devices = _cleaned(told.get("devices"))
    except RecursionError:
        raise malformed(VERB, "values that are nested without end") from None
    for launch in launches:
        device = devices.get(launch.full_name) if isinstance(devices, dict) else None
        if not isinstance(device, dict):
            raise malformed(VERB, f"nothing about {launch.full_name}")
        for key, kind in REQUIRED.items():
            if not isinstance(device.get(key), kind):
                raise malformed(VERB, f"{launch.full_name}: no {key}")
        if not all(isinstance(channel, dict) for channel in device["channels"].values()):
            raise malformed(VERB, f"{launch.full_name}: no figures")
    return {launch.full_name: devices[launch.full_name] for launch in launches}


def _cleaned(value: Any) -> Any:
    """Return plain values with texts that may reach a terminal, and finite numbers."""
    if isinstance(value, str):
        return clean_text(value[:WORDS_MAX])
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, list):
        return [_cleaned(each) for each in value[:ITEMS_MAX]]
    if isinstance(value, dict):
        return {clean_text(str(key)[:WORDS_MAX]): _cleaned(each) for key, each in value.items()}
    return value
