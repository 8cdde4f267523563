"""The name of a signal, and how processes ended that one killed which Python has no name for."""

import signal

import pytest

from cosmos_cli.system.bounded_process import describe_exit
from madns_runtime.hardware.driven import exit_text
from madns_runtime.lockstep import workers
from madns_runtime.signal_names import signal_name


@pytest.mark.parametrize(
    ("number", "name"),
    [(signal.SIGKILL, "SIGKILL"), (signal.SIGRTMIN + 1, f"signal {signal.SIGRTMIN + 1}")],
)
def test_every_signal_has_a_name_for_people(number, name):
    assert signal_name(number) == name


@pytest.mark.parametrize("number", range(1, signal.NSIG))
def test_every_end_by_a_signal_has_words(number):
    ways = (describe_exit, exit_text, workers._how)

    assert all(way(-number).endswith(f"killed by {signal_name(number)}") for way in ways)
