from __future__ import annotations

import os
import select
import signal

import pytest

from cosmos_cli.launch.signals import OperatorSignals


def test_signals_are_taken_in_order_and_wake_the_loop() -> None:
    with OperatorSignals() as signals:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGCHLD):
            os.kill(os.getpid(), number)
        readable = select.select([signals], [], [], 10)[0]
        taken = signals.take()

        assert readable == [signals]
        assert taken == [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
        assert signals.take() == []


def test_after_the_loop_a_ctrl_c_raises_but_a_hangup_does_not() -> None:
    with OperatorSignals() as signals:
        os.kill(os.getpid(), signal.SIGINT)
        signals.take()
        signals.raise_from_now()
        os.kill(os.getpid(), signal.SIGHUP)

        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)


def test_a_ctrl_c_that_the_loop_has_not_taken_raises_after_it() -> None:
    with OperatorSignals() as signals:
        os.kill(os.getpid(), signal.SIGHUP)
        os.kill(os.getpid(), signal.SIGINT)

        with pytest.raises(KeyboardInterrupt):
            signals.raise_from_now()


def test_handlers_are_given_back() -> None:
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGCHLD)
    before = [signal.getsignal(number) for number in numbers]

    with OperatorSignals():
        pass

    assert [signal.getsignal(number) for number in numbers] == before
