"""Values beyond reason, and too little memory, are told as what they are: never as a defect of COSMoS."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cosmos_cli import app
from cosmos_cli.errors import InputError
from cosmos_cli.models.loading import load_scenario
from cosmos_cli.ui.out_of_memory import is_out_of_memory

ROOT = Path(__file__).parents[3]
SCENARIO = "name: a\nsimulation: counter\nagents: {count: 1}\n"
DATA_KIB = (7_500, 8_500, 10_000, 12_000, 16_000, 20_000)
MARGIN_KIB = 1_000
BEFORE_ANY_WORD = "import cosmos_cli.ui.out_of_memory, gc, types"
"""What Python must be able to import before a line of ours can say what is wrong."""


def told(folder: Path, text: str = "", *overrides: str) -> str:
    path = folder / "a.yaml"
    path.write_text(SCENARIO + text)
    with pytest.raises(InputError) as caught:
        load_scenario(path, overrides)
    return str(caught.value)


@pytest.mark.parametrize("number", ["0x" + "f" * 100_000, "0o" + "7" * 100_000, "9" * 100_000])
def test_a_number_of_a_hundred_thousand_digits_is_a_fault_at_its_place(tmp_path, number):
    text = told(tmp_path, f"seed: {number}\n")

    assert "a.yaml:4:7: seed: expected a number of at most 300 digits" in text
    assert len(text) < 1000


@pytest.mark.parametrize("key", [".".join(["a"] * 3000), "x" + "[0]" * 3000])
def test_a_key_of_set_that_is_nested_three_thousand_deep_is_a_fault(tmp_path, key):
    text = told(tmp_path, "", f"parameters.{key}=1")

    assert "expected at most 64 levels of nesting" in text
    assert len(text) < 1000


@pytest.mark.parametrize("value", ["[" * 3000 + "]" * 3000, "{a: " * 3000 + "1" + "}" * 3000])
def test_a_value_that_is_nested_three_thousand_deep_is_a_fault(tmp_path, value):
    assert "expected at most 64 levels of nesting" in told(tmp_path, "", f"parameters.x={value}")
    assert "expected at most 64 levels of nesting" in told(tmp_path, f"parameters: {value}\n")


def test_what_both_nest_together_is_a_fault_of_the_scenario_as_well(tmp_path):
    key = ".".join(["a"] * 60)
    value = "[" * 60 + "]" * 60

    assert "parameters.a: unknown key" in told(tmp_path, "", f"parameters.{key}={value}")


@pytest.mark.process
def test_too_little_memory_is_told_as_such():
    codes = []
    for limit_kib in DATA_KIB:
        if run_limited(limit_kib - MARGIN_KIB, "-c", BEFORE_ANY_WORD).returncode:
            continue  # the interpreter itself does not start
        done = run_limited(
            limit_kib, "-m", "cosmos_cli.start", "validate", "scenarios/counter24.yaml"
        )
        codes.append(done.returncode)
        if done.returncode == 0:
            continue
        assert "defect of COSMoS" not in done.stderr
        assert "error: out of memory: the system gives this process no more" in done.stderr
        assert f"`ulimit -d` is {limit_kib} KiB" in done.stderr
        assert done.returncode == 3

    assert len(codes) >= len(DATA_KIB) - 2
    assert 3 in codes


def run_limited(limit_kib: int, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python with so much memory for data."""
    return subprocess.run(
        ["sh", "-c", f'ulimit -d {limit_kib}; exec "$@"', "sh", sys.executable, *arguments],
        cwd=ROOT,
        env=dict(os.environ),
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.mark.parametrize(
    ("error", "is_it"),
    [
        (MemoryError(), True),
        (OSError(12, "Cannot allocate memory"), True),
        (RuntimeError("can't start new thread"), True),
        (ImportError("libx.so: failed to map segment from shared object"), True),
        (RuntimeError("something else"), False),
        (ImportError("No module named x"), False),
        (OSError(28, "No space left on device"), False),
    ],
)
def test_memory_is_known_by_each_of_its_signs_and_through_what_it_led_to(error, is_it):
    try:
        try:
            raise error
        except type(error) as cause:
            raise KeyError("x") from cause
    except KeyError as outer:
        assert (is_out_of_memory(error), is_out_of_memory(outer)) == (is_it, is_it)


@pytest.mark.parametrize(("error", "at_once"), [(MemoryError(), [3]), (ValueError("x"), [])])
def test_a_process_that_found_no_memory_is_not_taken_down_in_order(monkeypatch, error, at_once):
    ended = []

    def fail():
        raise error

    monkeypatch.setattr(app, "make_app", fail)
    monkeypatch.setattr(app, "open_standard_streams", lambda: None)
    monkeypatch.setattr(app.gc, "freeze", lambda: None)
    monkeypatch.setattr(app.os, "_exit", ended.append)
    with pytest.raises(SystemExit) as caught:
        app.main(["run"])

    assert ended == at_once
    assert caught.value.code == (3 if at_once else 1)
