"""A folder that looks like the system of a Raspberry Pi, and a kit that makes machines ready from nothing."""

import hashlib
from pathlib import Path

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.liveness import SilenceWatch
from cosmos_cli.fleet.local import LocalConnection
from cosmos_cli.fleet.target import Target
from cosmos_cli.models.device_needs import NO_NEEDS
from cosmos_cli.models.machine_facts import SystemPaths
from cosmos_cli.provision import HELPER_PARTS
from cosmos_cli.provision.full_checks import FullChecks
from cosmos_cli.provision.inventory_steps import Content
from cosmos_cli.provision.up import MachineUp, UpOptions
from cosmos_cli.provision.up_table import MachineResult

FILES = {
    "etc/os-release": 'PRETTY_NAME="Debian GNU/Linux 12 (bookworm)"\nID=debian\nVERSION_ID="12"\n',
    "sys/firmware/devicetree/base/model": "Raspberry Pi 4 Model B Rev 1.4\0",
    "sys/class/thermal/thermal_zone0/temp": "48312\n",
    "sys/devices/platform/soc/soc:firmware/get_throttled": "50005\n",
    "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor": "ondemand\n",
    "sys/devices/system/cpu/cpu0/cpufreq/scaling_available_governors": "ondemand performance\n",
    "sys/devices/system/cpu/cpu1/cpufreq/scaling_governor": "ondemand\n",
    "sys/class/rfkill/rfkill0/type": "wlan\n",
    "sys/class/rfkill/rfkill0/soft": "0\n",
    "sys/class/rfkill/rfkill0/hard": "0\n",
    "sys/class/rfkill/rfkill1/type": "bluetooth\n",
    "sys/class/rfkill/rfkill1/soft": "1\n",
    "sys/class/rfkill/rfkill1/hard": "0\n",
    "sys/class/net/wlan0/operstate": "up\n",
    "sys/class/net/wlan0/wireless/x": "",
    "sys/class/net/eth0/operstate": "up\n",
    "proc/meminfo": "MemTotal:  3884152 kB\nMemAvailable:  3500000 kB\n",
    "proc/uptime": "4321.10 12000.00\n",
    "proc/sys/net/core/rmem_max": "212992\n",
    "proc/sys/kernel/random/boot_id": "7e9c8f0a-0000-4000-8000-000000000001\n",
}


def make_system(folder):
    """Write the system, and return where it is."""
    for name, text in FILES.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return SystemPaths(
        **{name: str(folder / name) for name in ("etc", "sys", "proc", "boot")},
    )


def connection_to(folder):
    target = Target(name="pi01", address="127.0.0.1", connection="local", root=str(folder))
    return LocalConnection(target)


class FakeKit:
    """Neither wheels nor an echo: what is tested is the way between."""

    def __init__(self, paths=None, trees=(), needs=NO_NEEDS):
        self.paths = paths or SystemPaths()
        self._trees = tuple(trees)
        self._needs = needs
        self.full_checks = FullChecks()

    def trees(self, machine):
        return self._trees

    def needs(self, machine):
        return self._needs

    def environments(self, machine, greeting, teller):
        return ()

    def read_file(self, path):
        return Content.of(Path(path).read_bytes())

    def udp_question(self, connection, machine):
        return {}

    def udp_heard(self, question):
        return 0

    def checks(self, wanted, udp, *, depth):
        return []

    def connect_again(self, connection):
        return LocalConnection(connection.target)


class Listener:
    """A teller that remembers."""

    def __init__(self):
        self.steps = []

    def step(self, title):
        self.steps.append(title)

    def detail(self, text):
        pass


def up(connection, machine, kit=None, listener=None, **options):
    """Return what became of a machine, as the command line does it."""
    try:
        with Helper.start(connection, HELPER_PARTS, watch=SilenceWatch(connection)) as helper:
            return MachineUp(
                connection=connection,
                helper=helper,
                machine=machine,
                resources=kit or FakeKit(),
                options=UpOptions(**options),
                teller=listener or Listener(),
                result=MachineResult(machine=machine.name),
            ).run()
    except MachineFailure as failure:
        return MachineResult(machine=machine.name, failure=failure)


def contents(folder):
    """Return every path below a folder with what it is: mode, time of its content, hash."""
    found = {}
    for path in sorted(Path(folder).rglob("*")):
        state = path.lstat()
        is_file = path.is_file() and not path.is_symlink()
        digest = hashlib.sha256(path.read_bytes()).hexdigest() if is_file else ""
        found[str(path.relative_to(folder))] = (state.st_mode, digest)
    return found


class CutStream:
    """A stream that is lost before a certain request."""

    def __init__(self, stream, counter):
        self._stream = stream
        self._counter = counter
        self._left_bytes = 0  # of the request that is being handed over

    def __getattr__(self, name):
        return getattr(self._stream, name)

    def write(self, data, *, timeout_s=0.0):
        self._counter["left"] -= not self._left_bytes
        if self._counter["left"] < 0:
            raise MachineFailure(FailureKind.LOST, "the connection broke")
        self._left_bytes = len(data)
        count = self._stream.write(data, timeout_s=timeout_s)
        self._left_bytes -= count
        return count


class CutConnection:
    """A connection that is lost before the request with a certain number, the helper's own program included."""

    def __init__(self, connection, requests):
        self._connection = connection
        self._counter = {"left": requests}

    @property
    def is_cut(self):
        return self._counter["left"] < 0

    def __getattr__(self, name):
        return getattr(self._connection, name)

    def open(self, command):
        return CutStream(self._connection.open(command), self._counter)
