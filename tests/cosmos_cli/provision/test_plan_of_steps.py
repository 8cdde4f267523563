"""The plan of `cosmos up`: from facts and wants, only what must change. Cases stand in cases/plans.json."""

import dataclasses
import json
import os
from dataclasses import dataclass
from types import SimpleNamespace

import pytest
from provision_machines import CASES, HOME, facts_of, told, wanted

from cosmos_cli.fleet.failure import MachineFailure
from cosmos_cli.models.machine_facts import MachineFacts
from cosmos_cli.onboard.facts import _file
from cosmos_cli.onboard.files import replace_file
from cosmos_cli.provision.desired import questions
from cosmos_cli.provision.gather_facts import gather_facts
from cosmos_cli.provision.step import Kind, Step
from cosmos_cli.provision.steps import RESERVE_BYTES, check_possible, notes_of, plan_steps
from cosmos_cli.provision.trees import TreeFile, tree_of
from cosmos_cli.provision.up import MachineUp, UpOptions
from cosmos_cli.provision.up_table import MachineResult

PLANS = json.loads((CASES / "plans.json").read_text())


@pytest.mark.parametrize("case", PLANS, ids=[case["name"] for case in PLANS])
def test_plan(case):
    facts = facts_of(**case.get("facts", {}))
    wants = wanted(
        variables=case.get("variables"),
        packages=case.get("packages", ()),
        provision=case.get("provision", ()),
    )
    if "failure" in case:
        with pytest.raises(MachineFailure) as caught:
            plan_steps(facts, wants)
        assert [caught.value.kind.value, caught.value.text] == case["failure"]
        assert caught.value.advice
        return

    steps = plan_steps(facts, wants)

    assert [[s.kind.value, s.title, s.needs_root] for s in steps] == case["steps"]


ENVIRONMENT_BYTES = 100_000_000


@dataclass(frozen=True)
class FakeEnvironment:
    key: str = "abc"
    lock: tuple = ("numpy", "msgpack")
    distribution_packages: tuple = ()

    def size_bytes(self, there=()):
        return sum(ENVIRONMENT_BYTES // 2 for name in self.lock if name not in there)


@dataclass(frozen=True)
class FakeTree:
    label: str = "runtime"
    hash: str = "0123456789abcdef"
    files: tuple = tuple(
        TreeFile(path=name, sha256=name * 64, mode=0o444, size_bytes=1, source=b"")
        for name in ("a", "b", "c")
    )
    size_bytes: int = 1_000_000


@pytest.mark.parametrize("zeros", ["", "00"])
def test_file_whose_owner_is_named_by_number_is_left_when_it_is_so(tmp_path, zeros):
    path, uid, gid = str(tmp_path / "a"), os.getuid(), os.getgid()
    owners = {"owner": f"{zeros}{uid}", "group": f"{zeros}{gid}"}
    replace_file(path, b"x", owners)
    facts = facts_of(files={path: _file(path, "hash")})

    wants = wanted(provision=[{"file": {"dest": path, "content": "x", **owners}}])
    others = wanted(
        provision=[{"file": {"dest": path, "content": "x", "owner": "4242", "group": "4243"}}]
    )

    assert plan_steps(facts, wants) == ()
    (step,) = plan_steps(facts, others)
    assert step.title.endswith("-> 4243") and ": owner " in step.title


def test_environment_and_trees_that_are_not_there_come_after_what_they_need():
    wants = wanted(
        packages=("htop",),
        environments=(FakeEnvironment(distribution_packages=("python3-numpy",)),),
        trees=(FakeTree(), FakeTree(label="scenario a", hash="ff")),
        variables={"cosmos_realtime_priority": 1},
        provision=({"packages": ["gpsd"]},),
    )

    steps = plan_steps(dataclasses.replace(facts_of(), trees=frozenset({"ff"})), wants)

    assert [step.title for step in steps] == [
        "packages htop, python3-numpy: install",
        "setting cosmos_realtime_priority: not set -> 1",
        "package gpsd: install",
        "environment abc: build with 2 packages",
        "tree runtime: send 3 files (0123456789ab)",
    ]


def test_pruning_keeps_what_is_wanted():
    wants = wanted(environments=(FakeEnvironment(),), trees=(FakeTree(),))
    facts = dataclasses.replace(
        facts_of(prunable=("trees/00", "wheels/11")),
        trees=frozenset({FakeTree().hash}),
        environments=frozenset({"abc"}),
    )

    (step,) = plan_steps(facts, wants)

    assert step.title == "prune what nobody uses: trees/00, wheels/11"
    assert step.requests[0].arguments["trees"] == [FakeTree().hash]
    assert step.requests[0].arguments["environments"] == ["abc"]


def refused(steps, **changes):
    with pytest.raises(MachineFailure) as caught:
        check_possible(facts_of(**changes), steps)
    assert caught.value.advice
    return caught.value.kind.value, caught.value.text


ROOTED = plan_steps(facts_of(), wanted(variables={"cosmos_wifi": False, "cosmos_bluetooth": False}))
ROOTLESS = plan_steps(facts_of(files={f"{HOME}/cosmos": None}), wanted())


def test_plan_without_steps_needs_no_room_and_no_root():
    check_possible(facts_of(disk={"free_bytes": 0}, sudo=False), ())


def test_disk_that_takes_no_records_is_refused_though_nothing_is_to_be_done():
    assert refused((), disk={"is_read_only": True})[0] == "read_only"
    assert refused((), disk={"is_writable": False})[0] == "step"


@pytest.mark.parametrize("steps", [(), ROOTLESS], ids=["nothing to do", "something"])
def test_disk_from_which_nothing_can_be_run_is_refused_before_anything_is_changed(steps):
    assert refused(steps, disk={"is_noexec": True}) == (
        "step",
        "/home/pi is on a file system that is mounted noexec: no Python package there could be loaded",
    )


def test_plan_without_root_needs_none():
    check_possible(facts_of(sudo=False), ROOTLESS)


def test_plan_that_needs_root_is_refused_with_its_steps_where_nobody_becomes_root():
    assert refused(ROOTED, sudo=False) == (
        "no_sudo",
        "pi cannot become root without a password, which is needed for:"
        " setting cosmos_wifi: on -> off; setting cosmos_bluetooth: on -> off",
    )
    check_possible(facts_of(sudo=True), ROOTED)


@pytest.mark.parametrize(("uid", "can"), [(1000, False), (0, True)])
def test_inventory_that_forbids_sudo_is_blamed_and_root_needs_none(uid, can):
    nothing = {"trees": {}, "environments": {}}
    answers = [{"ok": True, "value": value} for value in (told(user={"id": uid}), nothing)]
    helper = SimpleNamespace(call=lambda *asked, **how: SimpleNamespace(value=answers))

    facts, _ = gather_facts(helper, [{"arguments": {}}] * 2, may_become_root=False)

    assert facts.can_become_root is can
    if can:
        check_possible(facts, ROOTED)
        return
    with pytest.raises(MachineFailure) as caught:
        check_possible(facts, ROOTED)
    assert caught.value.kind.value == "no_sudo"
    assert caught.value.text == (
        "the inventory forbids to become root there (ansible_become: false), which is needed for:"
        " setting cosmos_wifi: on -> off; setting cosmos_bluetooth: on -> off"
    )
    assert "ansible_become" in caught.value.advice


def test_plan_that_needs_root_is_refused_with_what_sudo_says_of_it():
    words = "sudo: sorry, you must have a tty to run sudo"

    text = refused(ROOTED, sudo=False, sudo_refusal=words)[1]

    assert text.startswith(f"pi cannot become root without a password ({words}), which is needed")


def test_full_disk_is_refused_before_anything_is_sent():
    steps = plan_steps(facts_of(), wanted(environments=(FakeEnvironment(),)))
    needed = ENVIRONMENT_BYTES + RESERVE_BYTES

    check_possible(facts_of(disk={"free_bytes": needed}), steps)

    assert refused(steps, disk={"free_bytes": needed - 1}) == (
        "disk_full",
        "about 116.0 MB are needed on /home/pi, 116.0 MB are free",
    )


def test_wheels_that_are_there_take_no_room():
    """As those of the environment before, or of an `up` that was cut: it must find room to go on."""
    facts = dataclasses.replace(facts_of(), wheels=frozenset({"numpy"}))
    (step,) = plan_steps(facts, wanted(environments=(FakeEnvironment(),)))

    assert step.size_bytes == ENVIRONMENT_BYTES // 2
    check_possible(facts_of(disk={"free_bytes": ENVIRONMENT_BYTES}), (step,))


@pytest.mark.parametrize("kind", ["file", "line"])
def test_unit_is_read_by_systemd_in_the_step_that_writes_it(kind):
    """So that a cut between both leaves the step undone, or what was written is told as not read."""
    path = "/etc/systemd/system/a.service"
    action = (
        {"file": {"dest": path, "content": "[Service]\n"}}
        if kind == "file"
        else {"line": {"path": path, "line": "[Service]", "create": True}}
    )
    wants = wanted(provision=(action,))

    (step,) = plan_steps(facts_of(), wants)

    assert [request.verb for request in step.requests][1:] == ["service"]
    assert step.requests[1].arguments["reload"] and step.requests[1].as_root
    assert questions(wants)["units"] == ["a.service"]


def test_what_was_sent_before_needs_no_room_again():
    files = tuple(
        TreeFile(path=name, sha256=sha256, mode=0o444, size_bytes=1000, source=b"")
        for name, sha256 in (("a", "aa"), ("b", "aa"), ("c", "cc"))
    )
    first, second = tree_of("first", files), tree_of("second", files[1:])
    facts = dataclasses.replace(facts_of(), blobs=frozenset({"aa", "dd"}))

    steps = plan_steps(facts, wanted(trees=(first, second)))

    assert [step.size_bytes for step in steps] == [2000, 2000]


@pytest.mark.parametrize("missing_bytes", [0, 1])
def test_disk_without_room_for_all_is_pruned_before_anything_else_takes_room(missing_bytes):
    """Of what nobody uses three environments stay there: a fourth may find room only when the oldest has gone."""
    needed, freed = ENVIRONMENT_BYTES + RESERVE_BYTES, 100_000_000
    free = needed - freed - missing_bytes
    old = {"prunable": ("environments/old",), "prunable_bytes": freed}
    facts = facts_of(files={f"{HOME}/cosmos": None}, disk={"free_bytes": free}, **old)

    steps = plan_steps(
        facts, wanted(variables={"cosmos_realtime_priority": 1}, environments=(FakeEnvironment(),))
    )

    kinds = [step.kind.value for step in steps]
    assert kinds == ["directory", "prune", "setting", "environment"]
    if not missing_bytes:
        check_possible(facts, steps)
        return
    assert refused(steps, disk={"free_bytes": free}, **old) == (
        "disk_full",
        "about 116.0 MB are needed on /home/pi, 16.0 MB are free, and pruning frees 100.0 MB",
    )


def test_full_disk_is_pruned_where_nothing_else_is_to_be_done():
    prune = Step(kind=Kind.PRUNE, title="prune what nobody uses: trees/0")

    check_possible(facts_of(disk={"free_bytes": 500_000}), (prune,))

    kind, text = refused((*ROOTLESS, prune), disk={"free_bytes": 520_192})
    assert (kind, text.endswith(", 520.2 kB are free")) == ("disk_full", True)


def test_read_only_disk_and_foreign_folder_are_refused():
    assert refused(ROOTLESS, disk={"is_read_only": True})[0] == "read_only"
    assert refused(ROOTLESS, disk={"is_writable": False}) == (
        "step",
        "pi may not write in /home/pi",
    )


def test_facts_tell_the_clock_and_leave_out_what_only_the_plan_needed():
    facts = facts_of(clock={"utc_s": 1010.5})

    mapping = facts.to_mapping()

    assert mapping["clock_offset_s"] == 9.5  # at least: it was read within a second
    assert mapping["model"] == "Raspberry Pi 4 Model B Rev 1.4"
    assert mapping["radios"] == {"rfkill0": "bluetooth: on", "rfkill1": "wlan: on"}
    assert "files" not in mapping
    assert json.loads(json.dumps(mapping)) == mapping


def test_slow_answer_makes_no_clock_wrong():
    """Conditions of commands may take a minute, and the clock is read before them."""
    answer = told(clock={"utc_s": 1000.1})
    facts = MachineFacts.from_mapping(answer, asked_utc_s=1000.0, answered_utc_s=1060.0)

    assert facts.clock_offset_s == 0.0
    assert notes_of(facts, wanted()) == ()


@pytest.mark.parametrize(
    ("changes", "variables", "words"),
    [
        ({}, {}, ()),
        ({"clock": {"utc_s": 1004.0}}, {}, ()),
        ({"clock": {"utc_s": 1001.0 + 5.1}}, {}, ("5 s ahead",)),
        ({"clock": {"utc_s": 1000.0 - 7200}}, {}, ("2 h behind this computer's",)),
        ({"clock": {"utc_s": 1000.5 + 30}}, {}, ("30 s ahead of this computer's",)),
        ({"throttled": 0x50005}, {}, ("its supply voltage is too low and it is throttled",)),
        ({"throttled": 0x50000}, {}, ()),
        (
            {"disk": {"free_bytes": 3_000_000}},
            {},
            ("3.0 MB are free on /home/pi: records of a run",),
        ),
        ({}, {"cosmos_realtime_priority": 50}, ("is granted real-time priority 0, not 50",)),
        ({"uses_pam": False}, {"cosmos_realtime_priority": 50}, ("set `UsePAM yes` in",)),
        ({"uses_pam": True}, {"cosmos_realtime_priority": 50}, ("perhaps pam_limits is missing",)),
        ({"realtime_priority_max": 50}, {"cosmos_realtime_priority": 50}, ()),
        ({"realtime_priority_max": None}, {"cosmos_realtime_priority": 50}, ()),
        ({"user": {"id": 0}}, {"cosmos_realtime_priority": 50}, ()),
    ],
)
def test_notes(changes, variables, words):
    notes = notes_of(facts_of(**changes), wanted(variables=variables))

    assert len(notes) == len(words)
    assert all(word in note for word, note in zip(words, notes, strict=True))


@pytest.mark.parametrize(("is_planned", "count"), [(True, 0), (False, 1)])
def test_check_blames_no_server_for_a_limit_that_is_still_to_be_set(is_planned, count):
    wants = wanted(variables={"cosmos_realtime_priority": 50})
    facts = facts_of(uses_pam=True)
    steps = plan_steps(facts, wants) if is_planned else ()
    result = MachineResult(machine="pi01", facts=facts, planned=steps)
    others = dict.fromkeys(("connection", "helper", "machine", "resources", "teller"))
    options = UpOptions(is_check=True, has_texts=False, host=None)

    MachineUp(**others, options=options, result=result)._note(wants)

    assert len(result.notes) == count
