"""Settings are made, changed and put back; a cut between any two requests is repaired by the next plan."""

import contextlib
import dataclasses
import json

import pytest
from provision_machines import facts_of, wanted

from cosmos_cli.fleet.failure import MachineFailure
from cosmos_cli.models.inventory.settings import SETTINGS
from cosmos_cli.models.machine_facts import FileFact, Radio, SystemPaths
from cosmos_cli.provision.settings import read_memory, setting_steps

BUFFER = "/proc/sys/net/core/rmem_max"
GOVERNOR = "/sys/devices/system/cpu/cpu{}/cpufreq/scaling_governor"
WLAN = "/sys/class/rfkill/rfkill1/soft"
SYSCTL = "/etc/sysctl.d/90-cosmos.conf"
MEMORY = "/home/pi/cosmos/state/settings.json"
ALL = {
    "cosmos_receive_buffer_bytes": 8388608,
    "cosmos_realtime_priority": 50,
    "cosmos_cpu_governor": "performance",
    "cosmos_wifi": False,
    "cosmos_bluetooth": False,
}


class Cut(Exception):
    """The connection ends before a request."""


class Machine:
    """A machine that remembers what settings do to it."""

    def __init__(self, files=None):
        self.files = dict(files or {})
        self.user, self.home, self.memory_path = "pi", "/home/pi", MEMORY
        self.values = {
            BUFFER: "212992",
            GOVERNOR.format(0): "ondemand",
            GOVERNOR.format(1): "ondemand",
            WLAN: "0",
            "/sys/class/rfkill/rfkill0/soft": "0",
        }

    def facts(self):
        facts = facts_of()
        return dataclasses.replace(
            facts,
            user=self.user,
            governors={f"cpu{i}": self.values[GOVERNOR.format(i)] for i in (0, 1)},
            radios=tuple(
                Radio(
                    name=name,
                    type=kind,
                    is_soft_blocked=self.values[f"/sys/class/rfkill/{name}/soft"] == "1",
                )
                for name, kind in (("rfkill0", "bluetooth"), ("rfkill1", "wlan"))
            ),
            files={
                path: FileFact(kind="file", text=text)
                for path, text in {**self.files, BUFFER: f"{self.values[BUFFER]}\n"}.items()
            },
        )

    def plan(self, **variables):
        return list(setting_steps(self.facts(), wanted(self.home, variables=variables)))

    @contextlib.contextmanager
    def login(self, user, home):
        """Be another user, or have another folder of COSMoS, for a while."""
        before = self.user, self.home, self.memory_path
        self.user, self.home = user, home
        self.memory_path = f"{home}/cosmos/state/settings.json"
        yield
        self.user, self.home, self.memory_path = before

    def up(self, cut_at=None, **variables):
        """Carry the plan out, and return how many requests that were."""
        requests = [request for step in self.plan(**variables) for request in step.requests]
        for index, request in enumerate(requests):
            if index == cut_at:
                raise Cut
            self.do(request)
        return len(requests)

    def do(self, request):
        arguments = request.arguments
        match request.verb:
            case "write_file":
                assert request.as_root == (arguments["path"] != self.memory_path)
                self.files[arguments["path"]] = request.body.decode(errors="surrogateescape")
            case "remove_file":
                assert request.as_root
                del self.files[arguments["path"]]
            case "set_values":
                assert request.as_root
                for path, value in arguments["values"]:
                    assert path in self.values
                    self.values[path] = value

    @property
    def state(self):
        """Everything but what is remembered."""
        return {p: t for p, t in self.files.items() if p != MEMORY}, dict(self.values)

    @property
    def memory(self):
        return json.loads(self.files[MEMORY])["settings"]


def test_settings_are_made_once():
    machine = Machine()

    machine.up(**ALL)

    assert machine.values[BUFFER] == "8388608"
    assert machine.values[WLAN] == "1"
    assert machine.values[GOVERNOR.format(1)] == "performance"
    assert machine.files[SYSCTL].splitlines()[1:] == [
        "# for pi /home/pi/cosmos",
        "net.core.rmem_max = 8388608",
    ]
    assert "pi - rtprio 50\n" in machine.files["/etc/security/limits.d/90-cosmos.conf"]
    assert machine.plan(**ALL) == []


def test_logins_of_one_machine_share_the_file_of_priorities():
    """Each has its own folder of COSMoS there, and so its own memory."""
    limits = "/etc/security/limits.d/90-cosmos.conf"
    machine, memories = Machine(), {"pi": {}, "anna": {}}

    def up(user, **variables):
        facts = dataclasses.replace(machine.facts(), user=user)
        mine = {path: FileFact(kind="file", text=text) for path, text in memories[user].items()}
        facts = dataclasses.replace(facts, files={**facts.files, **mine})
        steps = list(setting_steps(facts, wanted(variables=variables)))
        for request in (request for step in steps for request in step.requests):
            machine.do(request)
        memories[user] = (
            {MEMORY: machine.files.pop(MEMORY)} if MEMORY in machine.files else memories[user]
        )
        lines = [e for e in machine.files.get(limits, "").splitlines() if e[0] != "#"]
        return len(steps), lines

    both = ["anna - rtprio 20", "pi - rtprio 50"]
    assert up("pi", cosmos_realtime_priority=50) == (1, ["pi - rtprio 50"])
    assert up("anna") == (0, ["pi - rtprio 50"])
    assert up("anna", cosmos_realtime_priority=20) == (1, both)
    assert up("pi", cosmos_realtime_priority=50) == (0, both)
    assert up("pi", cosmos_realtime_priority=60) == (1, ["anna - rtprio 20", "pi - rtprio 60"])
    assert up("pi") == (1, ["anna - rtprio 20"])
    assert up("pi") == (0, ["anna - rtprio 20"])
    assert up("anna") == (1, [])
    assert limits not in machine.files


def test_settings_are_put_back():
    machine = Machine()
    before = machine.state
    machine.up(**ALL)

    machine.up()

    assert machine.state == before
    assert machine.memory == {}
    assert machine.plan() == []


def test_one_setting_is_put_back_and_the_others_stay():
    machine, other = Machine(), Machine()
    machine.up(**ALL)
    less = {name: value for name, value in ALL.items() if name != "cosmos_cpu_governor"}
    other.up(**less)

    machine.up(**less)

    assert machine.state == other.state


def test_changed_setting_keeps_what_was_before_the_first():
    machine = Machine()
    before = machine.state
    machine.up(cosmos_receive_buffer_bytes=1_000_000)
    machine.up(cosmos_receive_buffer_bytes=2_000_000)

    assert machine.values[BUFFER] == "2000000"
    machine.up()
    assert machine.state == before


def test_file_that_somebody_else_wrote_comes_back():
    machine = Machine({SYSCTL: "net.core.rmem_max = 500000 # caf\udce9\n"})
    before = machine.state

    machine.up(cosmos_receive_buffer_bytes=1_000_000)
    assert machine.state != before
    machine.up()

    assert machine.state == before


def test_values_after_a_restart_are_made_again_and_still_put_back():
    machine = Machine()
    before = machine.state
    machine.up(**ALL)
    machine.values[BUFFER] = "300000"

    (step,) = machine.plan(**ALL)
    assert step.title == "setting cosmos_receive_buffer_bytes: 300000 -> 8388608"
    machine.up(**ALL)
    machine.up()

    assert machine.state == before


def test_lost_memory_leaves_no_file_of_ours_behind():
    machine = Machine()
    machine.up(**ALL)
    del machine.files[MEMORY]

    assert [step.title for step in machine.plan()][:1] == [
        "setting cosmos_receive_buffer_bytes: take away"
    ]
    machine.up()

    assert machine.files == {}
    assert machine.plan() == []


OTHERS = [("anna", "/home/anna"), ("pi", "/srv/second"), ("anna", "/home/pi")]


@pytest.mark.parametrize("other", OTHERS)
def test_settings_of_another_user_or_folder_are_not_taken_away(other):
    machine = Machine()
    machine.up(**ALL)
    memory = machine.files.pop(MEMORY)

    with machine.login(*other):
        asks_for_nothing, asks_for_the_same = machine.plan(), machine.plan(**ALL)

    assert asks_for_nothing == []
    assert [step.title for step in asks_for_the_same] == (
        [] if other[0] == "pi" else ["setting cosmos_realtime_priority: set otherwise -> 50"]
    )
    machine.files[MEMORY] = memory
    assert machine.plan(**ALL) == []


def test_two_folders_put_a_setting_back_one_after_the_other():
    machine = Machine()
    before = machine.state
    machine.up(cosmos_receive_buffer_bytes=1_000_000)
    first = machine.state
    with machine.login("anna", "/home/anna"):
        machine.up(cosmos_receive_buffer_bytes=2_000_000)
        machine.up()
        del machine.files[machine.memory_path]

    assert machine.state == first
    machine.up()
    assert machine.state == before


def test_setting_that_another_has_changed_since_is_left_to_that_one():
    machine = Machine()
    machine.up(cosmos_receive_buffer_bytes=1_000_000)
    with machine.login("anna", "/home/anna"):
        machine.up(cosmos_receive_buffer_bytes=2_000_000)
        del machine.files[machine.memory_path]
    before = machine.state

    (step,) = machine.plan()
    machine.up()

    assert step.title == "setting cosmos_receive_buffer_bytes: leave to anna /home/anna/cosmos"
    assert not step.needs_root
    assert (machine.state, machine.memory) == (before, {})
    assert machine.plan() == []


def test_file_of_an_older_version_is_claimed_once_and_taken_away_without_memory():
    machine = Machine()
    machine.up(**ALL)
    claimed = dict(machine.files)
    for path, text in machine.files.items():
        kept = [line for line in text.splitlines(keepends=True) if not line.startswith("# for")]
        machine.files[path] = "".join(kept)
    memory = machine.files.pop(MEMORY)
    assert machine.plan(**ALL) == []
    machine.files[MEMORY] = memory

    assert len(machine.plan(**ALL)) == len(ALL)
    machine.up(**ALL)

    assert machine.files == claimed
    assert machine.plan(**ALL) == []


@pytest.mark.parametrize("cut_at", range(30))
def test_cut_at_any_request_is_repaired(cut_at):
    machine, whole = Machine(), Machine()
    before = machine.state
    whole.up(**ALL)

    with contextlib.suppress(Cut):
        assert machine.up(cut_at=cut_at, **ALL) <= cut_at
    machine.up(**ALL)
    assert machine.state == whole.state
    assert machine.memory == whole.memory
    assert machine.plan(**ALL) == []

    with contextlib.suppress(Cut):
        machine.up(cut_at=cut_at)
    machine.up()
    assert machine.state == before
    assert machine.plan() == []


def test_setting_of_a_machine_without_such_values_is_kept_for_later():
    facts = dataclasses.replace(facts_of(), governors={}, radios=(), governors_available=())
    steps = list(
        setting_steps(
            facts, wanted(variables={"cosmos_cpu_governor": "performance", "cosmos_wifi": False})
        )
    )

    assert [[r.verb for r in step.requests] for step in steps] == [["write_file"] * 2] * 2


def test_folder_where_a_settings_file_belongs_is_told():
    facts = dataclasses.replace(facts_of(), files={SYSCTL: FileFact(kind="directory")})

    with pytest.raises(MachineFailure, match="expected a small file of text"):
        list(setting_steps(facts, wanted(variables={"cosmos_receive_buffer_bytes": 1})))


def test_every_setting_has_a_file_of_its_own():
    files = [setting.file(SystemPaths()) for setting in SETTINGS]

    assert len(set(files)) == len(files) == 5
    assert all(path.startswith("/etc/") and "90-cosmos" in path for path in files)


@pytest.mark.parametrize(
    ("text", "told", "cure"),
    [
        (
            '{"schema": 2, "settings": {}}',
            "is of a newer COSMoS (schema 2, this one knows 1)",
            "use",
        ),
        ('{"schema": "x", "settings": {}}', "is damaged", "remove it"),
        ('{"settings": {}}', "is damaged", "remove it"),
    ],
)
def test_memory_of_a_newer_program_is_not_called_damaged(text, told, cure):
    with pytest.raises(MachineFailure) as caught:
        read_memory(FileFact(kind="file", text=text))

    assert told in caught.value.text
    assert caught.value.advice.startswith(cure)
