"""
Makes a machine's outputs safe when the process that drives them is gone, or does not do it itself.

One process per machine, and only where outputs may move. It watches the devices' processes, the agents that own
outputs, and the supervisor, each through a descriptor that tells the kernel's word of its end; of an agent that
ends while others of its process go on, the supervisor tells it. When one of them
ends, a device's process has GRACE_S to say in the page that all is safe; then it is killed, and a process of the
guardian's opens the device anew for `make_safe` alone. That process stands by from the run's first seconds on: to
import a driver's libraries takes a small board longer than outputs may wait.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import traceback
from collections.abc import Callable, Mapping
from functools import partial
from time import monotonic
from typing import Final

from madns_runtime.hardware import messages, page
from madns_runtime.hardware.child_process import is_there
from madns_runtime.hardware.seat import DeviceSeat
from madns_runtime.reactor.forking import leave_parent
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.reactor.scheduling import die_with_parent, outlive_parent

GRACE_S: Final = 0.4
ATTEMPT_S: Final = 5.0
"""Time for opening a device anew and making it safe; what takes longer is killed, and tried again."""
CLOSE_S: Final = 0.5
"""Then to close it: what is safe stays so, and a close that does not return is no reason to try again."""
ATTEMPTS_MAX: Final = 3
RETRY_S: Final = 0.1
STAND_BY_S: Final = 1.0
"""Time from a device's start until a process stands by for it: the start of a run has the processors to itself."""
LINGER_S: Final = 20.0
"""Time after the supervisor's end: by then every attempt is over."""
WATCH, DRIVES, LEFT, OVER, SAFE = "watch", "drives", "left", "over", "safe"
"""Words: [WATCH, agent, pid], [DRIVES, device, pid], [LEFT, agent] of one that ends in a process which others keep, and
[OVER] to the guardian, [SAFE, device, how] from it."""


def guard_outputs(seats: Mapping[str, DeviceSeat], control: socket.socket) -> None:
    """
    Guard until the supervisor and all devices' processes are gone; never returns. Called in a forked child.

    Args:
        seats: Devices with outputs that may move, by full name.
        control: This process's end of its pair with the manager.
    """
    code = 1
    try:
        claims = frozenset[int]().union(*(seat.claims for seat in seats.values()))
        leave_parent(keep={control.fileno(), *claims})
        os.setsid()  # what ends the supervisor's group leaves the guardian to its work
        Guardian(seats, control).run()
        code = 0
    except BaseException as error:  # noqa: BLE001 - the last frame of a process
        traceback.print_exception(error)
    finally:
        os._exit(code)


class Guardian:
    """The loop of that process; arguments as of `guard_outputs`."""

    def __init__(self, seats: Mapping[str, DeviceSeat], control: socket.socket) -> None:
        self._reactor = Reactor()
        self._seats = seats
        self._control = control
        self._drivers: dict[str, int] = {}
        """Process that drives a device, by device."""
        self._attempts: dict[str, int] = {}
        self._helpers: dict[int, tuple[str, socket.socket]] = {}
        """Device and the socket on which its end is told, by process that makes the device safe."""
        self._standing_by: dict[str, tuple[int, socket.socket]] = {}
        """Process that stands by for a device, and the socket on which it is told to go on, by device."""
        self._retries = 0
        """Attempts that are still to be made."""
        self._has_supervisor = True

    def run(self) -> None:
        """Run to the end."""
        reactor = self._reactor
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            reactor.on_signal(number, lambda: None)  # it ends with those it watches
        reactor.on_signal(signal.SIGCHLD, self._reap)
        reactor.add_reader(self._control.fileno(), self._hear)
        reactor.run()
        for pid, _ in self._standing_by.values():  # they have opened nothing
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def _hear(self) -> None:
        has_heard = False
        for word, *rest in messages.receive_all(self._control):
            has_heard = True
            if word == OVER:
                self._expect_all_safe()  # also where a driver does not return
                continue
            if word == LEFT:
                self._owner_ended(str(rest[0]))
                continue
            name, pid = str(rest[0]), int(rest[1])
            if word == DRIVES:
                self._drivers[name] = pid
                self._attempts.pop(name, None)
                self._reactor.call_at(monotonic() + STAND_BY_S, partial(self._prepare, name))
                self._watch(pid, partial(self._driver_ended, name, pid))
            elif word == WATCH:
                self._watch(pid, partial(self._owner_ended, name))
        if not has_heard and messages.is_over(self._control):
            self._supervisor_ended()

    def _watch(self, pid: int, then: Callable[[], None]) -> None:
        """Call *then* when a process has ended; at once if it is gone already."""
        try:
            fd = os.pidfd_open(pid)
        except OSError:
            if is_there(pid):  # out of descriptors, say: it may live for long
                self._reactor.call_at(monotonic() + RETRY_S, partial(self._watch, pid, then))
            else:
                self._reactor.call_at(0.0, then)
            return

        def ended() -> None:
            self._reactor.remove_reader(fd)
            os.close(fd)
            then()

        self._reactor.add_reader(fd, ended)

    # What ends ----------------------------------------------------------------------------------

    def _driver_ended(self, name: str, pid: int) -> None:
        if self._drivers.get(name) != pid:
            return
        del self._drivers[name]
        if self._seats[name].page.header[page.STATE] != page.SAFE:
            self._make_safe(name)
        self._end_if_done()

    def _owner_ended(self, agent: str) -> None:
        for name, seat in self._seats.items():
            if seat.launch.owner == agent:
                self._expect_safe(name)

    def _supervisor_ended(self) -> None:
        self._has_supervisor = False
        self._reactor.remove_reader(self._control.fileno())
        self._expect_all_safe()
        self._reactor.call_at(monotonic() + LINGER_S, self._reactor.stop)
        self._end_if_done()

    def _expect_all_safe(self) -> None:
        for name in self._seats:
            self._expect_safe(name)

    def _expect_safe(self, name: str) -> None:
        """Give the device's process a while to make it safe."""
        header = self._seats[name].page.header
        pid, count = self._drivers.get(name), header[page.SAFE_COUNT]
        if pid is None or not header[page.MOVED]:
            return  # gone, which is seen to by itself; or nothing has moved since it was made safe

        def look() -> None:
            if self._drivers.get(name) != pid or header[page.SAFE_COUNT] > count:
                return
            if header[page.STATE] != page.OPEN:
                return  # closed: it was made safe when it was closed, and nothing moves it
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)  # its end brings `_driver_ended`

        self._reactor.call_at(monotonic() + GRACE_S, look)

    # What is done -------------------------------------------------------------------------------

    def _make_safe(self, name: str) -> None:
        """Open a device anew in a process of its own, for `make_safe` alone; where there is no room for it, a little later."""
        if not self._stand_by(name):
            self._retries += 1
            self._reactor.call_at(monotonic() + RETRY_S, partial(self._make_safe_again, name))
            return
        self._attempts[name] = self._attempts.get(name, 0) + 1
        header = self._seats[name].page.header
        header[page.ATTEMPTED] = header[page.MOVED]
        pid, line = self._standing_by.pop(name)
        self._helpers[pid] = name, line
        with contextlib.suppress(OSError):  # its end is seen by itself
            line.send(b"!")
        self._reactor.call_at(monotonic() + ATTEMPT_S, lambda: self._give_up(pid))

    def _prepare(self, name: str) -> None:
        """Have a process stand by for a device that is driven, as soon as there is room for it."""
        if name in self._drivers and not self._stand_by(name):
            self._reactor.call_at(monotonic() + STAND_BY_S, partial(self._prepare, name))

    def _stand_by(self, name: str) -> bool:
        """Have a process ready that has imported the driver, if there is none; return whether there is one."""
        if name in self._standing_by:
            return True
        try:
            line, child_line = socket.socketpair()
            pid = os.fork()
        except OSError:  # out of descriptors, processes or memory, which may be over in a moment
            return False
        if pid == 0:
            _open_and_make_safe(self._seats[name], child_line)
        child_line.close()
        self._standing_by[name] = pid, line
        return True

    def _make_safe_again(self, name: str) -> None:
        self._retries -= 1
        self._make_safe(name)

    def _give_up(self, pid: int) -> None:
        if pid in self._helpers:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def _reap_standing_by(self) -> None:
        """Forget those whose driver failed before it was wanted: it is tried anew when it is."""
        for name, (pid, line) in list(self._standing_by.items()):
            if os.waitpid(pid, os.WNOHANG)[0]:
                line.close()
                del self._standing_by[name]

    def _reap(self) -> None:
        self._reap_standing_by()
        for pid in list(self._helpers):
            if not os.waitpid(pid, os.WNOHANG)[0]:
                continue
            name, line = self._helpers.pop(pid)
            header = self._seats[name].page.header
            with line:
                is_safe = _has_said_so(line)
            if is_safe:
                header[page.SAFE_COUNT] += 1
                messages.send(self._control, [SAFE, name, "made safe by the guardian"])
                continue
            header[page.MOVED], header[page.ATTEMPTED] = 1.0, 0.0
            if self._attempts[name] < ATTEMPTS_MAX:
                self._retries += 1
                self._reactor.call_at(monotonic() + RETRY_S, partial(self._make_safe_again, name))
            else:
                messages.send(self._control, [SAFE, name, ""])
        self._end_if_done()

    def _end_if_done(self) -> None:
        if not (self._has_supervisor or self._drivers or self._helpers or self._retries):
            self._reactor.stop()


def _has_said_so(line: socket.socket) -> bool:
    """Tell whether a process that has ended said before that its device is safe: how it ended tells less."""
    try:
        return bool(line.recv(1, socket.MSG_DONTWAIT))
    except OSError:
        return False


def _open_and_make_safe(seat: DeviceSeat, line: socket.socket) -> None:
    """Make the driver, wait for the word, do it, and say so when it is done; ends the process."""
    try:
        die_with_parent()
        leave_parent(keep={line.fileno(), *seat.claims})
        device = seat.make()
        if not line.recv(1):
            return  # the guardian has ended, and all is safe
        outlive_parent()
        try:
            device.may_move, device.place = True, seat.launch.place
            seat.check_identity(device.open())
            # Before it is done: what a process that was started anew moves meanwhile is not taken for safe.
            seat.page.header[page.MOVED] = 0.0
            device.make_safe()
            seat.page.header[page.ATTEMPTED] = 0.0
            line.send(b"!", socket.MSG_NOSIGNAL)
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.setitimer(signal.ITIMER_REAL, CLOSE_S)
        finally:
            device.close()
    except BaseException as error:  # noqa: BLE001 - a driver may raise anything
        traceback.print_exception(error)
    finally:
        os._exit(0)
