"""`cosmos up` on one machine: this computer, with a folder for its system, through the real helper."""

import dataclasses
import hashlib
import os
import time

import pytest
from fake_system import (
    CutConnection,
    FakeKit,
    Listener,
    connection_to,
    contents,
    make_system,
    up,
)
from made_wheels import House, make_wheel
from provision_machines import machine_of

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.local import LocalConnection
from cosmos_cli.models.machine_facts import MachineFacts
from cosmos_cli.provision import HELPER_PARTS
from cosmos_cli.provision.sent_wheels import sent_wheel
from cosmos_cli.provision.trees import TreeFile, tree_of

pytestmark = pytest.mark.process
needs_root = pytest.mark.root

SETTINGS = {
    "cosmos_receive_buffer_bytes": 8388608,
    "cosmos_realtime_priority": 50,
    "cosmos_cpu_governor": "performance",
    "cosmos_wifi": False,
    "cosmos_bluetooth": False,
}
WITHOUT_SUDO = {"ansible_become": False, "cosmos_receive_buffer_bytes": 8388608}


@pytest.fixture
def place(tmp_path):
    """Return the folders: of COSMoS there, and one for files that steps make."""
    (tmp_path / "made").mkdir()
    return tmp_path


def steps_below(folder):
    return (
        {"become": False, "file": {"content": "a=1\n", "dest": f"{folder}/a.conf", "mode": "0600"}},
        {"become": False, "line": {"path": f"{folder}/a.conf", "line": "b=2"}},
        {
            "become": False,
            "command": {"run": f"echo done > {folder}/b", "creates": f"{folder}/b"},
        },
        {
            "become": False,
            "command": {"run": f"echo more >> {folder}/c", "unless": f"test -s {folder}/c"},
        },
    )


def machine_at(place, **entries):
    variables = {"cosmos_root": f"{place}/cosmos", **entries.pop("variables", {})}
    return machine_of(variables=variables, **entries)


def kinds(brought):
    return [(done.step.kind.value, done.changed) for done in brought.done]


def test_first_up_makes_what_is_missing_and_the_second_changes_nothing(place):
    machine = machine_at(place, provision=steps_below(place / "made")[2:])
    connection = connection_to(place / "cosmos")

    first = up(connection, machine)
    before = contents(place)
    second = up(connection, machine)

    assert first.failure is None
    assert kinds(first) == [("directory", True)] * 6 + [("command", True)] * 2
    assert (place / "made/c").read_text() == "more\n"
    assert (second.failure, second.changed_count) == (None, 0)
    assert contents(place) == before


def test_check_shows_the_plan_and_changes_nothing(place):
    machine = machine_at(place, provision=steps_below(place / "made"))
    connection = connection_to(place / "cosmos")
    listener = Listener()

    planned = up(connection, machine, listener=listener, is_check=True, has_texts=True)

    assert contents(place) == {"made": contents(place)["made"]}
    assert listener.steps == []
    done = up(connection, machine, listener=listener)
    assert [d.step.title for d in planned.done] == [d.step.title for d in done.done]
    assert listener.steps == [d.step.title for d in done.done]
    assert planned.planned[6].change.after == "a=1\n"


def test_contradicting_steps_are_at_least_carried_out_in_order(place):
    up(connection_to(place / "cosmos"), machine_at(place, provision=steps_below(place / "made")))

    assert (place / "made/a.conf").read_text() == "a=1\nb=2\n"
    assert (place / "made/a.conf").stat().st_mode & 0o777 == 0o600


def test_line_finds_the_file_that_a_command_before_makes_and_says_when_it_does_not(place):
    made = place / "made"
    command = {"become": False, "command": {"run": f"echo a > {made}/a", "creates": f"{made}/a"}}
    lines = [
        {"become": False, "line": {"path": f"{made}/{name}", "line": "x"}} for name in ("a", "b")
    ]

    brought = up(connection_to(place / "cosmos"), machine_at(place, provision=(command, *lines)))

    assert (made / "a").read_text() == "a\nx\n"
    assert brought.failure.text == (
        f"line in {made}/b: add x: {made}/b: there is no such file on this machine"
    )
    assert "create: true" in brought.failure.advice


def test_failing_command_ends_the_plan_and_keeps_what_was_done(place):
    made = place / "made"
    provision = (
        {"become": False, "command": {"run": f"touch {made}/a", "creates": f"{made}/a"}},
        {
            "become": False,
            "command": {"run": "echo first; echo the reason >&2; exit 7", "creates": f"{made}/b"},
        },
        {"become": False, "command": {"run": f"touch {made}/c", "creates": f"{made}/c"}},
    )

    brought = up(connection_to(place / "cosmos"), machine_at(place, provision=provision))

    assert brought.failure.kind is FailureKind.STEP
    assert brought.failure.text == (
        "command echo first; echo the reason >&2; exit 7: exit status 7:\nfirst\nthe reason"
    )
    assert kinds(brought)[6:] == [("command", True)]
    assert sorted(path.name for path in made.iterdir()) == ["a"]


def test_command_whose_condition_still_fails_is_noted(place):
    provision = ({"become": False, "command": {"run": "true", "unless": "false"}},)

    brought = up(connection_to(place / "cosmos"), machine_at(place, provision=provision))

    assert brought.failure is None
    assert brought.notes == [
        "command true: it ran, but its `unless` does not hold yet: the next `cosmos up` runs it again"
    ]


def test_condition_is_asked_once_where_it_holds_and_no_more_than_needed_where_it_does_not(place):
    """Each may take a minute: for the plan, when no other command works there, before the command and after it."""
    asked, made = place / "asked", place / "made/a"
    unless = f"echo x >> {asked}; test -e {made}"
    provision = ({"become": False, "command": {"run": f"touch {made}", "unless": unless}},)
    times = []
    for _ in range(2):
        brought = up(connection_to(place / "cosmos"), machine_at(place, provision=provision))
        assert brought.failure is None
        times.append(len(asked.read_text().splitlines()))

    assert times == [4, 5]


def test_condition_that_an_earlier_step_met_is_seen(place):
    target = place / "made/a"
    provision = (
        {"become": False, "file": {"content": "", "dest": str(target)}},
        {"become": False, "command": {"run": "exit 1", "creates": str(target)}},
    )

    brought = up(connection_to(place / "cosmos"), machine_at(place, provision=provision))

    assert (brought.failure, kinds(brought)[6:]) == (None, [("file", True), ("command", False)])


def test_other_command_that_works_there_is_waited_for_and_named(place, monkeypatch):
    monkeypatch.setattr("cosmos_cli.provision.up.LOCK_WAIT_S", 0.0)
    machine = machine_at(place)
    connection = connection_to(place / "cosmos")

    with Helper.start(connection) as board:
        board.call("lock", {"path": f"{place}/cosmos/state/lock", "holder": "cosmos wipe"})
        machine = machine_at(place, provision=steps_below(place / "made")[2:])
        brought = up(connection, machine)

    assert brought.failure.kind is FailureKind.BUSY
    assert "cosmos wipe" in brought.failure.text
    assert list((place / "made").iterdir()) == []


def test_machine_that_is_ready_needs_no_lock(place):
    connection = connection_to(place / "cosmos")
    up(connection, machine_at(place))

    with Helper.start(connection) as board:
        board.call("lock", {"path": f"{place}/cosmos/state/lock"})
        brought = up(connection, machine_at(place))

    assert (brought.failure, brought.changed_count) == (None, 0)


def test_helper_gives_up_the_lock_when_nobody_asks(place):
    connection = connection_to(place / "cosmos")
    lock = {"path": f"{place}/lock", "patience_s": 0.05}
    with Helper.start(connection) as silent, Helper.start(connection) as other:
        silent.call("lock", lock)
        until_s = time.monotonic() + 30.0
        while True:
            try:
                other.call("lock", {"path": f"{place}/lock"})
                break
            except MachineFailure as failure:
                assert failure.kind is FailureKind.BUSY
                assert time.monotonic() < until_s
                time.sleep(0.02)


def test_helper_that_gave_up_says_so_to_who_asks_afterwards(place):
    with Helper.start(connection_to(place / "cosmos")) as board:
        board.call("lock", {"path": f"{place}/lock", "patience_s": 0.05})
        time.sleep(0.2)
        with pytest.raises(MachineFailure, match="ended early: nothing was asked for 0.05 s"):
            for _ in range(100):  # on a busy machine it has not noticed yet
                board.call("versions", {"names": []})
                time.sleep(0.2)


def test_wheels_are_packed_before_the_lock_is_taken_however_long_that_takes(place, monkeypatch):
    """A helper that holds the lock gives up when nothing is asked for a minute; packing scipy takes longer on a Pi."""
    packed = []

    class Packing(FakeKit):
        def environments(self, machine, greeting, teller):
            house = House(place / "house", greeting)
            return (house.environment(make_wheel(place / "made", "nav-lib")),)

    def pack(path, locked, platform):
        with Helper.start(connection) as other:
            try:
                other.call("lock", {"path": f"{place}/cosmos/state/lock"})
            except MachineFailure as failure:
                packed.append(failure.kind)
            else:
                packed.append("free")
            return sent_wheel(path, locked, platform)

    monkeypatch.setattr("cosmos_cli.provision.environment.sent_wheel", pack)
    connection = connection_to(place / "cosmos")
    brought = up(connection, machine_at(place), Packing())

    assert (brought.failure, packed) == (None, ["free", FailureKind.BUSY])


def small_tree(text="print(1)\n"):
    data = text.encode()
    file = TreeFile(
        path="a.py",
        sha256=hashlib.sha256(data).hexdigest(),
        mode=0o444,
        size_bytes=len(data),
        source=data,
    )
    return tree_of("runtime", [file])


@pytest.fixture(scope="module")
def uncut(tmp_path_factory):
    """Return the paths below COSMoS's folder after an `up` that nothing disturbed."""
    folder = tmp_path_factory.mktemp("uncut")
    machine = machine_at(folder, provision=steps_below(folder)[2:])
    brought = up(connection_to(folder / "cosmos"), machine, FakeKit(trees=[small_tree()]))
    assert brought.failure is None
    return set(contents(folder / "cosmos"))


@pytest.mark.parametrize("requests", range(17))
def test_cut_before_any_request_is_repaired_by_the_next_up(place, uncut, requests):
    made = place / "made"
    machine = machine_at(place, provision=steps_below(made)[2:])
    kit = FakeKit(trees=[small_tree()])
    connection = connection_to(place / "cosmos")
    cut = CutConnection(connection, requests)
    brought = up(cut, machine, kit)
    assert cut.is_cut is (brought.failure is not None)
    assert cut.is_cut or requests > 4
    if brought.failure is not None:
        assert brought.failure.kind is FailureKind.LOST
        assert brought.failure.text.partition(", at ")[0] == "the connection broke"
    repaired = up(connection, machine, kit)
    again = up(connection, machine, kit)

    assert repaired.failure is None
    assert again.changed_count == 0
    assert set(contents(place / "cosmos")) == uncut
    assert (made / "c").read_text() == "more\n"


def test_half_written_file_of_a_power_cut_is_no_obstacle(place):
    folder = place / "made"
    (folder / ".a.conf.cosmos-new").write_text("half")
    provision = ({"become": False, "file": {"content": "a=1\n", "dest": f"{folder}/a.conf"}},)

    brought = up(connection_to(place / "cosmos"), machine_at(place, provision=provision))

    assert brought.failure is None
    assert [path.name for path in folder.iterdir()] == ["a.conf"]


def test_link_stays_a_link_and_its_file_is_changed(place):
    folder = place / "made"
    (folder / "real").write_text("x\n")
    (folder / "link").symlink_to("real")
    provision = ({"become": False, "line": {"path": f"{folder}/link", "line": "y"}},)

    up(connection_to(place / "cosmos"), machine_at(place, provision=provision))

    assert (folder / "link").is_symlink()
    assert (folder / "real").read_text() == "x\ny\n"


def test_line_keeps_bytes_that_are_no_text_and_the_mode(place):
    path = place / "made/a"
    path.write_bytes(b"caf\xe9\r\nb\r\n")
    path.chmod(0o640)
    provision = ({"become": False, "line": {"path": str(path), "line": "c"}},)

    up(connection_to(place / "cosmos"), machine_at(place, provision=provision))

    assert path.read_bytes() == b"caf\xe9\r\nb\r\nc\r\n"
    assert path.stat().st_mode & 0o777 == 0o640


def test_facts_of_a_board(place):
    kit = FakeKit(make_system(place / "system"))

    facts = up(connection_to(place / "cosmos"), machine_at(place), kit, is_check=True).facts

    assert facts.board.model == "Raspberry Pi 4 Model B Rev 1.4"
    assert facts.board.os_name == "Debian GNU/Linux 12 (bookworm)"
    assert facts.temperature_c == 48.312
    assert facts.throttled == 0x50005
    assert facts.memory_total_bytes == 3884152 * 1024
    assert facts.network.receive_buffer_bytes_max == 212992
    assert facts.network.wireless_up == ("wlan0",)
    assert facts.governors == {"cpu0": "ondemand", "cpu1": "ondemand"}
    assert [(radio.type, radio.is_soft_blocked) for radio in facts.radios] == [
        ("wlan", False),
        ("bluetooth", True),
    ]
    assert facts.uptime_s == 4321.1
    assert abs(facts.clock_offset_s) < 60.0
    assert facts.disk.free_bytes > 0


def test_facts_of_this_computer_need_nothing_of_a_board(place):
    with Helper.start(connection_to(place), HELPER_PARTS) as board:
        told = board.call("facts", {"root": f"{place}/not/there/yet", "sudo": True}).value

    assert told["disk"]["path"] == str(place)
    assert told["python"]["version"][0] == 3
    assert told["clock"]["utc_s"] > 1e9
    assert isinstance(told["sudo"], bool)


def test_several_requests_in_one_frame_fail_alone(place):
    with Helper.start(connection_to(place), HELPER_PARTS) as board:
        calls = [
            {"verb": "make_directories", "arguments": {"paths": ["/proc/nothing/here"]}},
            {"verb": "no such verb"},
            {"verb": "make_directories", "arguments": {"paths": [f"{place}/a"]}},
        ]
        answers = board.call("several", {"calls": calls}).value

    assert [answer["ok"] for answer in answers] == [False, False, True]
    assert "no verb" in answers[1]["error"]["text"]
    assert answers[2]["value"] == [f"{place}/a"]


def values(path):
    """Return what a file of the kernel says; how it ends its lines is its own affair."""
    return path.read_text().strip() if path.is_file() else None


@needs_root
def test_settings_are_made_on_a_system_and_put_back(place):
    if os.geteuid() != 0:
        pytest.skip("becomes root")
    kit = FakeKit(make_system(place / "system"))
    (place / "system/sys/class/net/wlan0/operstate").write_text("down\n")
    before = contents(place / "system")
    values_before = {path: values(place / "system" / path) for path in before}
    machine = machine_at(place, variables=SETTINGS)
    connection = connection_to(place / "cosmos")

    made = up(connection, machine, kit)
    again = up(connection, machine, kit)

    assert made.failure is None
    assert [done.step.title for done in made.done[6:]] == [
        "setting cosmos_receive_buffer_bytes: 212992 -> 8388608",
        "setting cosmos_realtime_priority: not set -> 50",
        "setting cosmos_cpu_governor: ondemand -> performance",
        "setting cosmos_wifi: on -> off",
        "setting cosmos_bluetooth: keep off after a restart, too",
    ]
    assert again.changed_count == 0
    assert (place / "system/proc/sys/net/core/rmem_max").read_text() == "8388608\n"
    assert (place / "system/sys/class/rfkill/rfkill0/soft").read_text() == "1\n"
    limits = (place / "system/etc/security/limits.d/90-cosmos.conf").read_text()
    assert limits.splitlines()[1:] == [
        f"# for {made.facts.user} {place}/cosmos",
        f"{made.facts.user} - rtprio 50",
    ]

    put_back = up(connection, machine_at(place), kit)

    assert put_back.failure is None
    after = contents(place / "system")
    assert not [path for path in after if "90-cosmos" in path]
    assert {path: values(place / "system" / path) for path in before} == values_before


@needs_root
def test_wifi_that_may_carry_the_connection_stays(place):
    kit = FakeKit(make_system(place / "system"))
    machine = machine_at(place, variables={"cosmos_wifi": False})

    brought = up(connection_to(place / "cosmos"), machine, kit)

    assert brought.failure.kind is FailureKind.UNSUPPORTED
    assert "cut this very connection" in brought.failure.text
    assert not (place / "cosmos").exists()


def test_machine_that_may_not_become_root_is_refused_before_anything_is_done(place, monkeypatch):
    read = MachineFacts.from_mapping

    def as_another(told, **at):
        return read({**told, "user": {**told["user"], "id": 1000}}, **at)

    monkeypatch.setattr(MachineFacts, "from_mapping", as_another)
    kit = FakeKit(make_system(place / "system"))
    machine = machine_at(place, variables=WITHOUT_SUDO)

    brought = up(connection_to(place / "cosmos"), machine, kit)

    assert brought.failure.kind is FailureKind.NO_SUDO
    assert not (place / "cosmos").exists()


@needs_root
def test_who_logs_in_as_root_needs_no_sudo(place):
    kit = FakeKit(make_system(place / "system"))
    machine = machine_at(place, variables=WITHOUT_SUDO)

    brought = up(connection_to(place / "cosmos"), machine, kit)

    assert brought.failure is None
    assert (place / "cosmos").exists()


def test_missing_interpreter_is_told_however_soon_its_shell_ends(place):
    """The shell there may end before or after the last byte was sent to it, hence often."""
    target = dataclasses.replace(connection_to(place).target, python="/nowhere/python3")

    for _ in range(20):
        with pytest.raises(MachineFailure, match="no such interpreter") as caught:
            Helper.start(LocalConnection(target), HELPER_PARTS)
        assert caught.value.kind is FailureKind.PYTHON


def test_what_is_no_python_is_told_with_what_to_look_at(place):
    target = dataclasses.replace(connection_to(place).target, python="/bin/true")

    with pytest.raises(MachineFailure, match=r"\(exit status 0\)") as caught:
        Helper.start(LocalConnection(target), HELPER_PARTS)

    assert "a Python that ansible_python_interpreter names" in caught.value.advice
