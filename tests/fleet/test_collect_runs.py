"""Real runs on virtual boards whose records are in trouble: a disk that fills, power that goes."""

import json
import os
import signal
import time

import pytest
from harness.cosmos_command import CosmosCommand
from harness.waiting import wait_until
from tower import Tower
from tower.fixtures import need_tower

pytestmark = pytest.mark.root

PATIENCE_S = 120.0
ENDLESS_S = 600
"""Of a run that ends by what happens to it, or by a word, however long that takes to come."""
SCENARIO = """
name: fleet
simulation: counter
agents: {count: 4, tick_hz: 50}
time: {mode: realtime, duration_s: DURATION}
timeouts: {agents_ready_s: 120, silence_s: 30, complete_s: 60, shutdown_s: 60}
"""


class Operator:
    """A person at the tower of two boards, which are ready for runs."""

    def __init__(self, tower, folder):
        self.tower = tower
        self.folder = folder
        self.inventory = folder / "tower.yaml"
        tower.write_inventory(self.inventory)
        self.cosmos = CosmosCommand(
            folder, COSMOS_CACHE=str(folder / "cache"), **tower.operator_environment()
        )

    def start(self, name, duration_s):
        """Start a run, and wait until its agents record."""
        scenario = self.folder / f"{name}.yaml"
        scenario.write_text(SCENARIO.replace("DURATION", str(duration_s)))
        process = self.cosmos.start("run", scenario, "-i", self.inventory, start_new_session=True)
        heard = []
        for line in process.stderr:
            heard.append(line)
            if line == "running\n":
                return process
        raise AssertionError(f"it did not start: {''.join(heard)}")

    def stop(self, process):
        """End a run in good order, and return what it has said: what had to happen in it has happened."""
        order = ("inject", "last", "run", "stop")
        # Refused until simulated time runs, which is a moment after the run is said to.
        wait_until(lambda: self.cosmos(*order).returncode == 0, "stop", patience_s=PATIENCE_S)
        return process.communicate(timeout=PATIENCE_S)[1]

    def last_run(self):
        return max((self.folder / "runs").glob("[0-9]*/run.json")).parent

    def document(self):
        return json.loads((self.last_run() / "run.json").read_bytes())

    def named(self):
        return {line.split(":")[0] for line in self.document()["data"]["missing"]}

    def living(self):
        runs = json.loads(self.cosmos("ps", "--json").stdout)["runs"]
        return [process for run in runs for process in run["processes"]]


@pytest.fixture(scope="module")
def operator(tmp_path_factory):
    need_tower()
    with Tower(count=2) as tower:
        operator = Operator(tower, tmp_path_factory.mktemp("operator"))
        made = operator.cosmos("up", "-i", operator.inventory)
        assert made.returncode == 0, made.stdout + made.stderr
        yield operator


@pytest.mark.nightly
def test_board_whose_disk_fills_during_a_run_is_named_and_its_records_are_cut_where_they_end(
    operator,
):
    process = operator.start("full", ENDLESS_S)
    time.sleep(3.0)  # so that there is something to cut
    operator.tower.fault("pi01", "fill")
    time.sleep(5.0)  # so that there is more than the last blocks of the files hold

    talk = operator.stop(process)
    operator.tower.fault("pi01", "unfill")

    assert process.returncode == 5, talk
    assert operator.named() == {"agent-01", "agent-02"}
    missing = " ".join(operator.document()["data"]["missing"])
    assert "cut after" in missing
    assert "No space left on device" in missing
    assert operator.tower.run("pi01", "ls cosmos/runs").stdout == ""
    assert operator.cosmos("collect").returncode == 5


def test_board_whose_card_fails_during_a_run_is_named_and_keeps_what_it_has(operator):
    process = operator.start("worn", ENDLESS_S)
    boots = operator.tower.state()["boards"]["pi01"]["boots"]
    # Else a busy computer's card may not have the folder yet.
    operator.tower.run("pi01", "sync -f .")
    try:
        operator.tower.fault("pi01", "ro")
        talk = operator.stop(process)

        assert process.returncode == 5, talk
        assert {"agent-01", "agent-02"} <= operator.named() <= {"agent-01", "agent-02", "pi01"}
        missing = " ".join(operator.document()["data"]["missing"])
        # The agents met it when they wrote, or it took a folder that the kernel had not written yet.
        assert "Read-only file system" in missing or "cannot be read there: Bad message" in missing
        assert operator.tower.run("pi01", "ls cosmos/runs").stdout != ""
        assert operator.tower.run("pi02", "ls cosmos/runs").stdout == ""
    finally:
        operator.tower.fault("pi01", "reboot")
        operator.tower.wait_until_on("pi01", boots + 1)
    again = operator.cosmos("collect")
    assert again.returncode == 5, again.stderr
    # A file that the card has damaged cannot be read after the repair either: then nothing is deleted, and it is said.
    is_damaged = "kept there" in again.stderr or "could not be deleted there" in again.stderr
    assert operator.tower.run("pi01", "ls cosmos/runs").stdout == "" or is_damaged, again.stderr
    operator.tower.run("pi01", "rm -rf cosmos/runs/*", check=False)


@pytest.mark.nightly
def test_run_that_lost_the_power_of_everything_is_collected_afterwards(operator):
    process = operator.start("power", ENDLESS_S)
    time.sleep(3.0)
    boots = {name: board["boots"] for name, board in operator.tower.state()["boards"].items()}
    own = [entry["pid"] for entry in operator.living() if entry["role"] in ("operator", "host")]
    assert process.pid in own
    for name in ("pi01", "pi02"):
        operator.tower.run(name, "sync -f .")  # else the kernel keeps the records for half a minute
    # Nobody notices that the first is gone, and ends the run in good order on the second.
    for pid in own:
        os.kill(pid, signal.SIGSTOP)
    for name in ("pi01", "pi02"):
        operator.tower.fault(name, "crash")
    for pid in own:
        os.kill(pid, signal.SIGKILL)
    process.communicate(timeout=PATIENCE_S)
    for name in ("pi01", "pi02"):
        operator.tower.wait_until_on(name, boots=boots[name] + 1)
    assert operator.document()["status"] == "running"

    done = operator.cosmos("collect")

    assert done.returncode == 5, done.stderr
    document = operator.document()
    assert document["status"] == "failed"
    assert operator.named() >= {"host", "agent-01", "agent-02", "agent-03", "agent-04"}
    assert document["records"]["written"] > 0
    assert document["records"]["truncated"] > 0
    assert (operator.last_run() / "tables/ticks.parquet").exists()
    assert operator.last_run().with_name(f"{operator.last_run().name}.tar.zst").exists()
    for name in ("pi01", "pi02"):
        assert operator.tower.run(name, "ls cosmos/runs").stdout == ""
    again = operator.cosmos("collect")
    assert (again.returncode, operator.document()) == (5, document)


def test_run_that_is_left_to_itself_is_collected_when_it_is_over(operator):
    scenario = operator.folder / "alone.yaml"
    scenario.write_text(SCENARIO.replace("DURATION", "25"))
    begun_s = time.monotonic()
    assert operator.cosmos("run", scenario, "-i", operator.inventory, "--detach").returncode == 0

    is_early = time.monotonic() - begun_s < 12.0  # a busier computer may come when all is over
    early = operator.cosmos("collect")
    until_s = time.monotonic() + PATIENCE_S
    while operator.cosmos("collect", "--json", "--quiet").returncode == 2:
        assert time.monotonic() < until_s
        time.sleep(0.5)
    done = operator.cosmos("collect")

    assert early.returncode in ((2,) if is_early else (0, 2)), early.stderr
    if early.returncode:
        assert "is still running" in early.stderr
    assert done.returncode == 0, done.stderr
    assert operator.document()["status"] == "complete"
