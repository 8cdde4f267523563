"""Every command over hostile text in every place: no raw control character reaches the terminal."""

from __future__ import annotations

import json
import os
import pty
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from harness.synthetic_run import SyntheticRun

from cosmos_cli import app

pytestmark = pytest.mark.process

COSMOS = (sys.executable, "-m", "cosmos_cli.start")
HOSTILE = "\x1b]0;owned\x07\x1b[2J\x1b[31m\x9b1m\x7f\r\u202e\u200b\u2028[red]{task}"
IN_YAML = HOSTILE.encode("unicode_escape").decode().replace('"', '\\"')
RAW = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2060-\u2069\ufeff]")
STEERING = ("\x1b]", "\x07", "\x1b[2J", "\x9b", "\x7f", "\u202e", "\u200b", "\u2028")
"""What a picture on a terminal never needs; its own colours and cursor movements it does."""
TIMEOUT_S = 120.0
PLUGIN = f"""
from dataclasses import dataclass
from madns_runtime.plugin.api import AgentSimulation, HostSimulation, Simulation
HOSTILE = {HOSTILE!r}
@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters:
    how: str = "no"
class Host(HostSimulation):
    pass
class Agent(AgentSimulation):
    def setup(self, context, initial):
        self.context = context
        context.log("warning", HOSTILE)
        context.log("error", "two\\nlines" + HOSTILE)
    def step(self, tick):
        if tick.index == 2 and self.context.parameters.how == "raise":
            raise ValueError(HOSTILE + "\\n" + HOSTILE)
    def finish(self):
        return {{"checks": [{{"name": HOSTILE, "limit": 0, "got": 1, "passed": False}}]}}
def check(parameters, agents, base_directory):
    if parameters.how == "check":
        return [HOSTILE]
    if parameters.how == "import":
        raise OSError(HOSTILE)
    return []
simulation = Simulation(name="p", parameters=Parameters, host=":Host", agent=":Agent", check=":check")
"""
SCENARIO = """\
name: a
simulation: ./p.py:simulation
agents: {count: 2, tick_hz: 20}
time: {mode: lockstep, duration_s: 0.5}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "place"
    path.mkdir()
    (path / "p.py").write_text(PLUGIN)
    (path / "a.yaml").write_text(SCENARIO)
    return path


def environment(folder: Path) -> dict[str, str]:
    own = {
        "COSMOS_STATE_DIR": str(folder / "state"),
        "COSMOS_CACHE": str(folder / "cache"),
        "COSMOS_RUNS": str(folder / "runs"),
        "PYTHONPATH": str(Path(__file__).parents[3]),
        "TERM": "xterm",
        "COLUMNS": "250",
    }
    return {**os.environ, **own}


def said(folder: Path, *arguments: str | bytes) -> tuple[int, str]:
    """Run a command off a terminal; return its exit code and all that it printed."""
    done = subprocess.run(
        [*COSMOS, *arguments],
        cwd=folder,
        env=environment(folder),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        timeout=TIMEOUT_S,
        check=False,
    )
    return done.returncode, done.stdout.decode()


def shown(folder: Path, *arguments: str | bytes, answer: bytes = b"") -> str:
    """Run a command on a terminal of its own; return all that it wrote there."""
    leader, follower = pty.openpty()
    os.write(leader, answer)
    process = subprocess.Popen(
        [*COSMOS, *arguments],
        cwd=folder,
        env=environment(folder),
        stdin=follower,
        stdout=follower,
        stderr=follower,
        start_new_session=True,
    )
    os.close(follower)
    told = b""
    try:
        while data := _read(leader):
            told += data
        process.wait(TIMEOUT_S)
    finally:
        process.kill()
        process.wait()
        os.close(leader)
    return told.decode(errors="replace")


def _read(descriptor: int) -> bytes:
    try:
        return os.read(descriptor, 65_536)
    except OSError:  # the terminal's other side is closed
        return b""


def assert_harmless(text: str) -> None:
    found = RAW.search(text)
    assert found is None, ascii(text[max(0, found.start() - 200) : found.end() + 20])


def assert_steers_nothing(text: str) -> None:
    for sequence in STEERING:
        place = text.find(sequence)
        assert place < 0, ascii(text[max(0, place - 200) : place + 40])


HOSTILE_FILES = {
    "key": f'name: a\nsimulation: counter\nagents: {{count: 2}}\n"{IN_YAML}": 1\n',
    "name": f'name: "{IN_YAML}"\nsimulation: counter\nagents: {{count: 2}}\n',
    "simulation": f'name: a\nsimulation: "{IN_YAML}"\nagents: {{count: 2}}\n',
    "agents": f'name: a\nsimulation: counter\nagents: {{names: ["{IN_YAML}", b]}}\n',
    "parameter": f'name: a\nsimulation: counter\nagents: {{count: 2}}\nparameters: {{"{IN_YAML}": 1}}\n',
    "elements": "name: a\nsimulation: constellation\nagents: {count: 2}\n"
    f'parameters: {{satellites: {{elements: "{IN_YAML}"}}}}\n',
    "raw": f"name: {HOSTILE}\n",
    "comment": f"name: a # {HOSTILE}\nagents: no\n",
    "text": f'"{IN_YAML}"\n',
}


COMMAND_LINES = [
    ("X",),
    ("--X",),
    ("validate", "X"),
    ("plan", "a.yaml", "--set", "X=1"),
    ("validate", "a.yaml", "--set", "X"),
    ("run", "a.yaml", "-i", "X"),
    ("schema", "X"),
    ("init", "X"),
    ("inventory", "-i", "X"),
    ("up", "-i", "X"),
    ("ping", "-i", "X"),
    ("doctor", "-i", "X"),
    ("exec", "-i", "X", "true"),
    ("packages", "X"),
    ("packages", "install", "X", "-i", "X"),
    ("reboot", "-i", "X"),
    ("wipe", "-i", "X"),
    ("ps", "-i", "X"),
    ("down", "X"),
    ("runs", "--runs", "X"),
    ("collect", "X"),
    ("report", "X"),
    ("diff", "X", "X"),
    ("logs", "X"),
    ("facts", "-i", "X"),
    ("devices", "X"),
    ("devices", "test", "X", "-i", "X"),
    ("tabulate", "X", "--rate-hz", "1"),
]
"""X stands for the hostile text."""


@pytest.fixture
def told(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str]]:
    """Return a function that runs a command in this process, which is quicker; nothing is a terminal."""
    monkeypatch.chdir(folder)
    for name, value in environment(folder).items():
        monkeypatch.setenv(name, value)

    def run(*arguments: str) -> tuple[int, str]:
        code = app.run(list(arguments))
        captured = capsys.readouterr()
        return code, captured.out + captured.err

    return run


@pytest.mark.parametrize("place", HOSTILE_FILES)
def test_scenario(folder: Path, told: Callable[..., tuple[int, str]], place: str) -> None:
    (folder / "s.yaml").write_text(HOSTILE_FILES[place])

    for verb in (["validate"], ["plan"], ["run"], ["validate", "--json"]):
        code, text = told(*verb, "s.yaml")

        assert code == 2, text
        assert_harmless(text)


@pytest.mark.parametrize("arguments", COMMAND_LINES, ids=" ".join)
def test_command_line(told: Callable[..., tuple[int, str]], arguments: tuple[str, ...]) -> None:
    for more in ((), ("--json",)):
        code, text = told(*(HOSTILE if word == "X" else word for word in arguments), *more)

        assert "Traceback" not in text
        assert "defect" not in text
        assert code in (0, 2, 3), text
        assert_harmless(text)


@pytest.mark.parametrize("arguments", [("X",), ("validate", "X"), ("up", "-i", "X")], ids=" ".join)
def test_command_line_on_a_terminal(folder: Path, arguments: tuple[str, ...]) -> None:
    assert_steers_nothing(shown(folder, *(HOSTILE if word == "X" else word for word in arguments)))


LOUD = """
import os, sys
print("to stdout \\x1b]0;owned\\x07")
sys.stderr.write("to stderr \\x9b1m\\n")
os.system("echo of a child")
sys.stderr.write("without an end")
"""


def test_what_a_plugin_prints_when_it_is_imported_is_cleaned(folder: Path) -> None:
    (folder / "p.py").write_text(PLUGIN + LOUD)

    code, text = said(folder, "validate", "a.yaml")

    assert code == 0
    for told in ("to stdout \\x1b]0;owned", "to stderr", "of a child", "without an end"):
        assert told in text
    assert_harmless(text)
    assert_steers_nothing(shown(folder, "validate", "a.yaml"))


def test_plugin_that_prints_without_end_holds_nobody_up(folder: Path) -> None:
    endless = "import os\nwhile True:\n    os.write(1, b'y' * 5000 + b'\\n')\n"
    (folder / "p.py").write_text(PLUGIN + endless)
    start_s = time.monotonic()

    code, text = said(folder, "validate", "a.yaml", "--set", "timeouts.loading_s=1")

    assert code == 2
    assert "it was not done within 1 s" in text
    assert "more bytes were printed" in text
    assert len(text) < 100_000
    assert time.monotonic() - start_s < 60


@pytest.mark.parametrize("how", ["no", "raise", "check"])
def test_plugin(folder: Path, how: str) -> None:
    option = f"parameters.how={how}"

    code, text = said(folder, "run", "a.yaml", "--set", option)

    assert code == (2 if how == "check" else 4 if how == "no" else 1), text
    if how == "no":  # a check of such a name is none: the run's remarks tell of it
        (document,) = folder.glob("**/run.json")
        text += "\n".join(json.loads(document.read_text())["remarks"])
    assert "owned" in text
    assert_harmless(text)
    if how == "raise":
        assert_steers_nothing(shown(folder, "run", "a.yaml", "--set", option))


def test_recorded_run(folder: Path, told: Callable[..., tuple[int, str]]) -> None:
    """What a run recorded is foreign as well: report, collect, diff, runs and ps read it later."""
    for _ in range(2):
        made = SyntheticRun(folder / "runs").write()
        made.run.left_result_json.write_text(json.dumps(made.result()))
        assert told("collect", made.run.name)[0] == 0
        document = json.loads(made.run.run_json.read_text())
        document |= {"verdict": HOSTILE, "remarks": [HOSTILE], "scenario": HOSTILE}
        document["data"]["missing"] = [HOSTILE]
        document["versions"] = {HOSTILE: HOSTILE}
        document["checks"][0]["name"] = HOSTILE
        made.run.run_json.write_text(json.dumps(document))

    for arguments in (
        ("report", "1"),
        ("runs",),
        ("diff", "1", "2"),
        ("report", "1", "--json"),
        ("diff", "1", "2", "--json"),
        ("collect", "1"),
        ("ps",),
    ):
        code, text = told(*arguments)

        assert "defect" not in text
        assert code in (0, 1, 4, 5), (arguments, text)
        assert_harmless(text)
    assert_steers_nothing(shown(folder, "report", "2"))


def test_paths(tmp_path: Path) -> None:
    """A folder's name may hold anything but a slash and a zero, and need not be UTF-8."""
    folder = tmp_path / os.fsdecode(HOSTILE.encode() + b"\xff\xfe")
    folder.mkdir()
    (folder / "p.py").write_text(PLUGIN)
    (folder / "a.yaml").write_text(SCENARIO.replace("tick_hz", "tack_hz"))
    (folder / "b.yaml").write_text(SCENARIO)
    (folder / f"i{HOSTILE}.yaml").write_text("all: {hosts: {1: 2}}")

    for arguments in (
        ("validate", folder / "a.yaml"),
        ("run", folder / "b.yaml"),
        ("plan", folder / "b.yaml"),
        ("runs",),
        ("report",),
        ("inventory", "-i", folder / f"i{HOSTILE}.yaml"),
        ("ping", "-i", folder / f"i{HOSTILE}.yaml"),
        ("init", f"{HOSTILE}x"),
    ):
        _, text = said(folder, *map(os.fspath, arguments))

        assert "defect" not in text
        assert_harmless(text)


def test_damaged_run_tells_its_files(tmp_path: Path) -> None:
    made = SyntheticRun(tmp_path / "runs").write()
    path = made.stream("agent-01", "ticks")
    path.write_bytes(path.read_bytes() + HOSTILE.encode() + b"\n")
    (path.parent / f"{HOSTILE}.jsonl").write_text(HOSTILE)
    made.run.left_result_json.write_text(json.dumps(made.result(reason=HOSTILE, who=HOSTILE)))

    for arguments in (("collect", "1"), ("report", "1"), ("collect", "1", "--json")):
        code, text = said(tmp_path, *arguments)

        assert "defect" not in text, text
        assert code in (0, 1, 4, 5)
        assert_harmless(text)


@pytest.mark.parametrize("answer", [b"y\n", b"n\n"])
def test_question_on_a_terminal(folder: Path, answer: bytes) -> None:
    inventory = folder / f"i{HOSTILE}.yaml"
    inventory.write_text("all: {hosts: {pi1: {ansible_host: 127.0.0.1, ansible_port: 1}}}\n")

    text = shown(folder, "reboot", "-i", str(inventory), answer=answer)

    assert "reboot 1 machine (pi1)? [y/N]" in text
    assert ("interrupted" in text) == (answer == b"n\n")
    assert_steers_nothing(text)
