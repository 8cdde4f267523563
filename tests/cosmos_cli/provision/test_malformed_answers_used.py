"""An answer that has its shape can be worked with, whatever else it says: by plans, checks, tables and lists."""

import json
import math
from pathlib import Path
from types import SimpleNamespace

import pytest
from harness.altered_values import all_altered
from provision_machines import BOARD, CASES, HOME, machine_of, wanted

from cosmos_cli.collect.wipe import _run_there
from cosmos_cli.commands.ps import RunProcesses, _rows
from cosmos_cli.commands.wipe import _row
from cosmos_cli.doctor.case import Case, Wants
from cosmos_cli.doctor.judge import judge
from cosmos_cli.fleet.answers.parts import greeting
from cosmos_cli.fleet.answers.shapes import WrongShape
from cosmos_cli.fleet.answers.verbs import answer_shape
from cosmos_cli.fleet.failure import MachineFailure
from cosmos_cli.fleet.layout import Layout
from cosmos_cli.fleet.target import Target
from cosmos_cli.launch.living_processes import _seen
from cosmos_cli.models.machine_facts import MachineFacts
from cosmos_cli.onboard.processes import RunEnding
from cosmos_cli.provision.desired import questions
from cosmos_cli.provision.environment import Installed, check_distribution
from cosmos_cli.provision.platform import greeted_platform, wheel_tags
from cosmos_cli.provision.steps import check_possible, installed_question, notes_of, plan_steps
from cosmos_cli.provision.up_table import MachineResult

HEALTHY = json.loads((CASES.parents[1] / "doctor" / "healthy.json").read_text())
SETTINGS = {
    "cosmos_realtime_priority": 50,
    "cosmos_wifi": False,
    "cosmos_cpu_governor": "performance",
    "cosmos_receive_buffer_bytes": 4_000_000,
}
PROVISION = (
    {"line": {"path": "/etc/hosts", "line": "10.0.0.1 tower"}},
    {"command": {"run": "true", "creates": "/tmp/x"}},
    {"service": {"name": "ssh", "enabled": True}},
)
PROCESS = {
    "run": "0001-a",
    "role": "agent",
    "name": "agent-1",
    "pid": 12,
    "start_ticks": 5,
    "boot_id": "b",
    "node": "pi01",
    "run_directory": "/home/pi/r",
    "utc": "2026-01-01T00:00:00Z",
}
RUN = {"name": "0001-a-0011", "bytes": 10, "files": 1, "newest_s": 1_700_000_000, "living": []}


def wants():
    return wanted(variables=SETTINGS, packages=("htop",), provision=PROVISION)


def asked_facts():
    return questions(wants())


def told_facts():
    """The board's answer, to what is asked of it here."""
    asked = asked_facts()
    files = {path: {"kind": "missing"} for path in asked["files"]}
    found = {path: fact for path, fact in BOARD["files"].items() if path in files}
    return {
        "memory_lock_bytes_max": None,
        "temperature_c": None,
        "throttled": None,
        "uses_pam": True,
        "governors_available": [],
        **{key: value for key, value in BOARD.items()},
        "os": {"id": "", "version": "", "name": "", "code": "", **BOARD["os"]},
        "files": {**files, **found},
        "services": dict.fromkeys(asked["services"], {"enabled": "disabled", "active": "inactive"}),
        "packages": dict.fromkeys(asked["packages"]),
        "conditions": dict.fromkeys(asked["conditions"], False),
        "stale_units": [],
    }


def use_facts(value):
    facts = MachineFacts.from_mapping(value, asked_utc_s=1000.0, answered_utc_s=1001.0)
    json.dumps(facts.to_mapping())
    result = MachineResult(machine="pi01", facts=facts)
    assert len(result.row(is_check=False)) == 3
    notes_of(facts, wants())
    steps = plan_steps(facts, wants())
    check_possible(facts, steps)


def use_doctor(value):
    for finding in judge(Case.of("pi01", {**value, "asked_utc_s": 1.0}, Wants(machines=1))):
        assert json.dumps(finding.to_mapping(), allow_nan=False)


def use_processes(value):
    seen = [_seen("pi01", dict(mapping)) for mapping in value]
    entries = tuple(each.entry for each in seen)
    run = RunProcesses("r", "pi01", "d", {each.entry.pid: each.age_s for each in seen}, entries)
    _rows(run, is_every_agent=True)
    _rows(run, is_every_agent=False)


def use_runs(value):
    for entry in value:
        there = _run_there(None, Target(name="pi01", address="a"), entry, {})
        assert json.dumps(there.to_mapping())
        _row("pi01", there, "kept")


def use_versions(value):
    needed = SimpleNamespace(name="numpy", specifier=">=1.24", package="python3-numpy")
    board = SimpleNamespace(call=lambda *_, **__: SimpleNamespace(value=value))
    platform = SimpleNamespace(label="a board")
    content = SimpleNamespace(distributed=[needed])
    check_distribution(board, SimpleNamespace(content=content, platform=platform))


def use_greeting(value):
    wheel_tags(greeted_platform(value))
    assert wanted(home=value["home"]).layout.root
    assert machine_of()


def use_ending(value):
    assert json.dumps(RunEnding.from_mapping(value).to_mapping())


def use_installed(value):
    assert all(isinstance(each, bool) for each in Installed.from_mapping(value).trees.values())


GREETING = {
    "python": "3.11.2",
    "executable": "/usr/bin/python3",
    "machine": "aarch64",
    "bits": 64,
    "libc": "glibc 2.36",
    "uid": 1000,
    "home": HOME,
    "boot_id": "",
    "node": "pi01",
    "pid": 77,
}
INSTALLED = {
    "folders": {kind: f"/c/{kind}" for kind in ("trees", "environments", "wheels")},
    "trees": {},
    "environments": {},
    "prunable": {"trees": ["a"], "environments": [], "wheels": []},
    "prunable_bytes": 4096,
    "wheels": ["numpy-2.0.0.dist-info"],
    "blobs": ["0" * 64],
}
ROUND_TRIPS = {"round_trips": {"count": 1}, "wake_ups": {"count": 1}}
USES = {
    "facts": (asked_facts, told_facts, use_facts),
    "doctor": (lambda: ROUND_TRIPS, lambda: told_doctor(), use_doctor),
    "processes": (lambda: {"ages": True}, lambda: [{**PROCESS, "age_s": 3.5}], use_processes),
    "end_run": (
        dict,
        lambda: {"run": "r", "ended": [PROCESS], "killed": [], "left": [PROCESS]},
        use_ending,
    ),
    "inventory_runs": (dict, lambda: [RUN, {**RUN, "living": ["agent"]}], use_runs),
    "versions": (lambda: {"names": ["numpy"]}, lambda: {"numpy": "1.24.2"}, use_versions),
    "installed": (lambda: installed_question(wants()), lambda: INSTALLED, use_installed),
}


def told_doctor():
    told = json.loads(json.dumps(HEALTHY))
    del told["asked_utc_s"], told["here"]
    told["facts"] = {
        **told_facts(),
        **dict.fromkeys(("files", "services", "packages", "conditions"), {}),
        "user": HEALTHY["facts"]["user"],
    }
    return told


@pytest.mark.slow
@pytest.mark.parametrize("verb", USES)
def test_answer_of_its_shape_can_be_used(verb):
    asked, told, use = USES[verb]

    fates = fates_of(answer_shape(verb, asked()), told(), use)

    assert fates["used"] >= 1 and fates["refused"] >= 10, fates


def test_greeting_of_its_shape_can_be_used():
    fates = fates_of(greeting, GREETING, use_greeting)

    assert fates["used"] >= 20 and fates["refused"] >= 100, fates


def fates_of(shape, real, use):
    """Use every alteration of a real answer that has its shape; return how many have, and how many have not."""
    shape(real, "")
    fates = {"used": 0, "refused": 0}
    for number, value in enumerate(all_altered(real)):
        try:
            shape(value, "")
        except WrongShape:
            fates["refused"] += 1
            continue
        with_failures(use, value, number)
        fates["used"] += 1
    return fates


def with_failures(use, value, number):
    """Use it; a machine's failure is as good as a success, whatever else is raised is told."""
    try:
        use(value)
    except MachineFailure:
        pass
    except Exception as error:
        raise AssertionError(
            f"alteration {number}: {error!r} for {json.dumps(value)[:3000]}"
        ) from error


def test_numbers_that_are_none_have_no_shape():
    for value in (math.nan, math.inf, 10**400, True, "1"):
        with pytest.raises(WrongShape):
            answer_shape("facts", asked_facts())({**told_facts(), "temperature_c": value}, "")


def test_layout_knows_no_board():
    assert Layout(str(Path(HOME) / "c")).runs == "/home/pi/c/runs"
