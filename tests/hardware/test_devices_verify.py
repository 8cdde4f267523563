"""What `cosmos devices verify` shows, and how it ends."""

from __future__ import annotations

import json

import pytest

from cosmos_cli.app import run as cosmos
from cosmos_cli.commands.devices_verify import read_parameters, verify_driver
from cosmos_cli.errors import InputError
from cosmos_cli.ui.console import Console
from tests.hardware.bench import is_late

pytestmark = pytest.mark.process


def test_parameters_come_from_files_and_by_name(tmp_path):
    (tmp_path / "null.yaml").write_text("outputs: [valve]\nlow: -1\n")
    found = read_parameters([str(tmp_path / "null.yaml"), "low=-2.5", "high=1"])
    assert found == {"outputs": ["valve"], "low": -2.5, "high": 1}
    with pytest.raises(InputError):
        read_parameters(["high="[:-1]])


def test_a_driver_that_holds_ends_with_0_and_another_with_4(capsys, tmp_path, monkeypatch):
    code = verify_driver(Console(json=True), "null", ["outputs=[valve]"])
    findings = json.loads(capsys.readouterr().out)["findings"]
    assert {f["name"] for f in findings} >= {"descriptors", "kill -9", "safe at its end"}
    assert [f for f in findings if f["passed"] is False and not is_late(f)] == []
    assert code == (4 if any(map(is_late, findings)) else 0)

    monkeypatch.chdir(tmp_path)
    assert verify_driver(Console(), "./none.py:Line", []) == 4
    shown = capsys.readouterr()
    assert "declaration" in shown.out
    assert "NO" in shown.out
    assert "declaration does not hold" in shown.err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("verify",), "expected one KIND"),
        (("verify", "null", "-i", "x.yaml"), "no inventory"),
        (("--parameters", "a=1"), "--parameters is of verify alone"),
    ],
)
def test_the_command_says_what_it_expects(words, told, capsys):
    assert cosmos(["devices", *words]) == 2
    assert told in " ".join(capsys.readouterr().err.split())


def test_the_command_verifies_a_users_driver_beside_it(capsys, tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text(
        "import time\n"
        "from madns_runtime.hardware.contract import Channel, Device, DeviceKind, Sample\n"
        "class Mine(Device):\n"
        "    kind = DeviceKind(name='mine', summary='mine', channels=(Channel(name='a'),))\n"
        "    def read(self):\n"
        "        return Sample(values={'a': 'x\\x1b[31m'}, taken_s=time.monotonic())\n"
    )
    monkeypatch.chdir(tmp_path)
    assert cosmos(["devices", "verify", "./mine.py:Mine"]) == 4
    shown = capsys.readouterr()
    assert "shapes" in shown.out
    assert "\x1b[31m" not in shown.out + shown.err
