"""Messages between agents of a plug-in of one's own, from end to end: the cars of `tests/cars`, in both time modes."""

import json
import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import orjson
import pytest
from harness.cosmos_command import LOOSE

pytestmark = pytest.mark.process

CARS = 7
DURATION_S = 4
HZ = 10
SEED = 1
SCENARIO = f"""
name: ring-road
seed: {SEED}
agents: {{count: {CARS}, tick_hz: {HZ}}}
time: {{mode: lockstep, duration_s: {DURATION_S}}}
deadline: {{max_miss_ratio: 1}}
"""
STANDING = """
simulation: ring_cars:simulation
parameters:
  ring_m: 1000
  spaces_m: [100, 120, 140, 160]
  speed_m_s: 0
  driver: {acceleration_m_s2: 1.0e-9}
"""
"""Cars that hardly move: who is in reach of whom stays as it is."""
TICKS = DURATION_S * HZ
PACKAGE = Path(__file__).parents[1] / "cars/ring_cars"


def run(folder, *settings, code=0, plugin=None, change=("", "", "")):
    """Run the cars of `tests/cars`, or a plug-in's file; *change* is a module of the cars, a text and another."""
    folder.mkdir(exist_ok=True)
    own = STANDING
    if plugin is None:
        shutil.copytree(PACKAGE, folder / "ring_cars", ignore=shutil.ignore_patterns("*.pyc"))
        name, before, after = change
        if name:
            text = (PACKAGE / name).read_text()
            assert before in text
            (folder / "ring_cars" / name).write_text(text.replace(before, after))
    else:
        (folder / "ring_road.py").write_text(plugin)
        own = "simulation: ./ring_road.py:simulation"
    (folder / "ring_road.yaml").write_text(SCENARIO + own)
    command = [sys.executable, "-m", "cosmos_cli.app", "run", str(folder / "ring_road.yaml")]
    command += ["--json", "--quiet", "--no-report", "--runs", str(folder / "runs")]
    for setting in (*LOOSE, *settings):
        command += ["--set", setting]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        check=False,
        timeout=240,
        env={
            **os.environ,
            "COSMOS_STATE_DIR": str(folder / "state"),
            "PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")]),
        },
    )
    assert done.returncode == code, done.stdout + done.stderr
    result = json.loads(done.stdout)
    return result, folder / "runs" / result["run"]


def rows(evidence, stream):
    lines = []
    for path in sorted(evidence.glob(f"agents/*/{stream}.jsonl")):
        found = [orjson.loads(line) for line in path.read_bytes().splitlines()]
        lines += [(path.parent.name, *line) for line in found if isinstance(line, list)]
    return lines


def check_account(result):
    """Assert that every message is accounted on both sides, and return the account."""
    account, cars = result["between_agents"], result["simulation"]["agents"].values()
    fates = ("delivered", "lost", "refused", "in_flight")
    assert account["sent"] == sum(account[fate] for fate in fates)
    assert account["undelivered"] == 0
    assert account["transmissions"] == sum(car["sent"] for car in cars)
    receivers = account["receivers"]
    assert account["delivered"] == sum(receivers[fate] for fate in ("received", "held", "no_room"))
    assert receivers["received"] == sum(car["heard"] for car in cars)
    return account


@pytest.fixture(scope="module")
def in_lockstep(runs_folder):
    """The run that the others are compared with: its result and its directory."""
    return run(runs_folder / "lockstep")


def test_cars_hear_those_in_reach_and_every_message_is_accounted(in_lockstep):
    result, evidence = in_lockstep

    account = check_account(result)
    assert account["transmissions"] == 2 * CARS * TICKS
    # At 0, 100, 220, 360, 520, 620 and 740 m: the 4th and the 7th car do not reach the next one. Of the others each
    # is heard by it, and a broadcast by one car or two: 10 in each tick.
    assert account["sent"] == (CARS + 10) * TICKS
    assert account["refused_because"] == {"out_of_range": 2 * TICKS}
    told = Counter((car, reason) for car, _, reason in rows(evidence, "refused"))
    assert told == {("agent-04", "out_of_range"): TICKS, ("agent-07", "out_of_range"): TICKS}
    # 1 % of 600, by five standard deviations.
    assert 0 < account["lost"] < 6 + 5 * 2.5
    # What was sent in the last tick arrives after it.
    assert account["receivers"]["held"] > 0
    assert account["receivers"]["late"] == account["in_flight"] == account["known_late"] == 0
    heard = rows(evidence, "heard")
    pairs = {(car, sender) for car, _, sender, _ in heard}
    assert ("agent-01", "agent-02") in pairs
    assert len(pairs) == 10
    assert {tick for _, tick, *_ in heard} == set(range(1, TICKS))


def test_the_same_seed_gives_the_same_records_and_another_gives_others(in_lockstep, tmp_path):
    first, _ = in_lockstep
    again, other = (run(tmp_path / str(seed), f"seed={seed}")[0] for seed in (SEED, SEED + 1))

    assert first["records_sha256"] == again["records_sha256"] != other["records_sha256"]
    assert first["between_agents"] == again["between_agents"]


@pytest.mark.nightly
def test_in_real_time_the_account_is_as_exact(in_lockstep, tmp_path):
    due, _ = in_lockstep
    result, evidence = run(tmp_path / "realtime", "time.mode=realtime")

    account = check_account(result)
    if result["timing"]["missed"] == 0:  # a tick that was missed has sent nothing
        wanted = due["between_agents"]
        names = ("transmissions", "sent", "lost", "refused_because")
        assert {name: account[name] for name in names} == {name: wanted[name] for name in names}
    assert ("agent-01", "agent-02") in {
        (car, sender) for car, _, sender, _ in rows(evidence, "heard")
    }


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_messages_that_leave_slowly_are_on_their_way_at_the_end(tmp_path, mode):
    slow = ("parameters.rate_byte_s=100", "parameters.loss=0")
    result, _ = run(tmp_path, f"time.mode={mode}", *slow)

    account = check_account(result)
    assert account["in_flight"] > 0
    assert account["delivered"] > 0
    assert account["lost"] == 0


FAULTS = [
    (
        ("__init__.py", '    medium="ring_cars.host:v2v",\n', ""),
        r"agent-0.: Car.step raised .* declares no medium.*agent.py:\d+",
    ),
    (
        ("agent.py", "send(self._behind", "send('car-99'"),
        r"agent-0.: Car.step raised .*got 'car-99'.*agent.py:\d+",
    ),
    (
        ("agent.py", "def hear(", "def listen("),
        r"agent-0.: agent-0. sent a message, and Car has no hear\(",
    ),
    (
        ("host.py", "    return LinkMedium(", "    return {}\n    LinkMedium("),
        "host: RingRoad.medium returned a dict: expected a medium",
    ),
    (
        ("host.py", "road.reach,", "road.none,"),
        "host: RingRoad.medium raised AttributeError",
    ),
    (
        ("host.py", "reach=road.reach", "reach=1"),
        "host: RingRoad.medium raised PluginError: LinkMedium: reach: expected None or a function",
    ),
]
IDS = ("no medium", "no such agent", "no hear", "no such medium", "no medium made", "broken medium")


def in_both_modes():
    """Yield each fault in each mode: in one of them, by turns, every night alone."""
    for number, (name, fault) in enumerate(zip(IDS, FAULTS, strict=True)):
        for place, mode in enumerate(("lockstep", "realtime")):
            marks = (pytest.mark.nightly,) if number % 2 == place else ()
            yield pytest.param(*fault, mode, id=f"{name}-{mode}", marks=marks)


@pytest.mark.parametrize(("change", "words", "mode"), list(in_both_modes()))
def test_what_is_wrong_is_told_with_who_did_it(tmp_path, mode, change, words):
    settings = (f"time.mode={mode}", "agents.count=3")
    result, _ = run(tmp_path, *settings, code=1, change=change)

    assert re.search(words, f"{result['who']}: {result['reason']}")


def test_the_guides_cars_hear_each_other(tmp_path):
    guide = (Path(__file__).parents[2] / "docs/plugins.md").read_text()
    section = guide.partition("## Messages between agents")[2]
    plugin = section.partition("```python\n")[2].partition("```")[0]

    result, _ = run(tmp_path, plugin=plugin)

    account, cars = result["between_agents"], result["simulation"]["agents"]
    assert cars["agent-01"] == {"heard": ["agent-02"], "refused": 0}
    assert cars["agent-04"] == {"heard": ["agent-03", "agent-05"], "refused": TICKS}
    # Of the six that ask the first car whether it is near only its neighbour reaches it.
    assert account["refused_because"] == {"out_of_range": 5 * TICKS}
    # A chain of seven has six pairs that hear each other.
    assert account["sent"] == (6 * 2 + 1 + 5) * TICKS
