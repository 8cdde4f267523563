"""
The tower's switch: a bridge in a network namespace of its own, with one cable to the operator.

The namespace lives only as long as the supervisor holds its descriptor. When the supervisor ends, even
by SIGKILL, bridge and ports end with it, and with the far end of the uplink its near end: nothing has to
be cleaned up in the operator's namespace. Boards have no route but their own network, and the uplink
does not forward.
"""

from __future__ import annotations

import ipaddress
import json
import os
import signal
import subprocess
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from . import kernel

FIRST_NETWORK = 77
NETWORK_PREFIX_BITS = 16
PATIENCE_S = 120.0
LOSS_SCALE = 10_000
"""Loss is set in hundredths of a percent."""


class NetworkError(Exception):
    """The tower's network cannot be made."""


@dataclass(frozen=True, slots=True)
class Network:
    """A private /16; the operator is its first address, boards follow in the block .1.x."""

    prefix: str

    @property
    def operator(self) -> str:
        return f"{self.prefix}.0.1"

    @property
    def cidr(self) -> str:
        return f"{self.prefix}.0.0/{NETWORK_PREFIX_BITS}"

    def address(self, number: int) -> str:
        """Return the address of the board with this number, from 1."""
        return f"{self.prefix}.1.{number}"

    def hardware_address(self, number: int) -> str:
        """Return a locally administered hardware address."""
        low, high = (int(part) for part in self.prefix.split("."))
        return f"02:00:{low:02x}:{high:02x}:01:{number:02x}"


def check_network(prefix: str) -> Network:
    """Return the network `10.77`, if it is one that a tower may have and nobody here uses."""
    network = Network(prefix)
    try:
        wanted = ipaddress.ip_network(network.cidr)
    except ValueError as error:
        raise NetworkError(
            f"network: expected two numbers such as 10.77, got {prefix!r}"
        ) from error
    if not wanted.is_private:
        raise NetworkError(f"network: {wanted} is not private; take one such as 10.77")
    for used in list_networks():
        if used.overlaps(wanted):
            raise NetworkError(
                f"network {wanted} is in use here ({used}); choose another: --network"
            )
    return network


def find_network(index: int) -> Network | None:
    """Return the network of the tower with this index, or None if it is in use."""
    try:
        return check_network(f"10.{FIRST_NETWORK + index}")
    except NetworkError:
        return None


def list_networks() -> list[ipaddress.IPv4Network]:
    """Return every IPv4 network that this namespace has an address in or a route to."""
    found = []
    for entry in json.loads(_run(["ip", "-4", "-json", "route", "show", "table", "all"]) or "[]"):
        text = entry.get("dst", "default")
        if text not in ("default", "0.0.0.0/0"):
            found.append(ipaddress.ip_network(text, strict=False))
    return [network for network in found if isinstance(network, ipaddress.IPv4Network)]


class Switch:
    """
    The bridge and its cables.

    Args:
        network: Addresses.
        uplink: Name of the interface that the operator gets.
    """

    def __init__(self, network: Network, uplink: str) -> None:
        self.network = network
        self.uplink = uplink
        self._namespace = _make_namespace()
        self._batch(
            "link set lo up",
            "link add tower type bridge forward_delay 0 stp_state 0 mcast_snooping 0",
            "link set tower addrgenmode none up",
            f"link add port0 type veth peer name {uplink} netns {os.getpid()}",
            "link set port0 addrgenmode none master tower up",
        )
        lines = (
            f"link set {uplink} addrgenmode none",
            f"address add {network.operator}/{NETWORK_PREFIX_BITS} dev {uplink}",
            f"link set {uplink} up",
        )
        _run(["ip", "-batch", "-"], text="\n".join(lines))
        self._lossy: set[int] = set()
        _forbid_forwarding(uplink)

    def plug(self, ports: Iterable[tuple[int, int]]) -> None:
        """
        Lay cables to new network namespaces, as their eth0.

        Args:
            ports: Number of a board, and a process in its network namespace.
        """
        lines = []
        for number, process in ports:
            hardware = self.network.hardware_address(number)
            peer = f"peer name eth0 address {hardware} netns {process}"
            lines.append(f"link add port{number} type veth {peer}")
            lines.append(f"link set port{number} addrgenmode none master tower up")
        self._batch(*lines)

    def unplug(self, number: int) -> None:
        """Take a board's cable away; it may have gone with the board."""
        self._lossy.discard(number)
        self._batch(f"link del port{number}", is_forced=True)

    def set_link(self, number: int, *, is_up: bool) -> None:
        """Pull a board's cable, or plug it in again."""
        self._batch(f"link set port{number} {'up' if is_up else 'down'}")

    def set_loss(
        self, number: int, process: int, loss_percent: float, *, is_udp_alone: bool = False
    ) -> None:
        """
        Lose this share of a board's packets, in each direction; 0 loses none.

        The rules sit on the switch's side of the cable: a drop in the board's own output would show as an
        error of its send call.

        Args:
            number: Of the board.
            process: One in its network namespace.
            loss_percent: 0 to 100.
            is_udp_alone: Lose UDP datagrams and nothing else.
        """
        table = f"netdev port{number}"
        share = round(loss_percent * LOSS_SCALE / 100)
        drop = "drop" if share >= LOSS_SCALE else f"numgen random mod {LOSS_SCALE} < {share} drop"
        of = "meta l4proto udp " if is_udp_alone else ""
        rules = [f"add table {table}", f"delete table {table}"]
        if loss_percent > 0:
            rules.append(f"add table {table}")
            for hook in ("ingress", "egress"):
                chain = f"type filter hook {hook} device port{number} priority 0;"
                rules.append(f"add chain {table} {hook} {{ {chain} }}")
                rules.append(f"add rule {table} {hook} {of}{drop}")
        (self._lossy.add if loss_percent > 0 else self._lossy.discard)(number)
        # One packet must be one packet: else bundles of 64 kB are lost or not. It costs speed.
        board = ["nsenter", f"--net=/proc/{process}/ns/net"]
        _run([*board, "ip", "link", "set", "eth0", "gso_max_segs", _bundle(loss_percent > 0)])
        _run(["ip", "link", "set", self.uplink, "gso_max_segs", _bundle(bool(self._lossy))])
        _run(["nft", "-f", "-"], text="\n".join(rules), namespace=self._namespace)

    def close(self) -> None:
        """Let the switch go, and with it every cable."""
        _run(["ip", "link", "del", self.uplink], is_forced=True)
        os.close(self._namespace)

    def _batch(self, *lines: str, is_forced: bool = False) -> None:
        command = ["ip", *(["-force"] if is_forced else []), "-batch", "-"]
        _run(command, text="\n".join(lines), namespace=self._namespace, is_forced=is_forced)


def remove_interface(name: str) -> None:
    """Delete what is left of an uplink whose switch lives on."""
    _run(["ip", "link", "del", name], is_forced=True)


def _bundle(is_lossy: bool) -> str:
    return "1" if is_lossy else "65535"


def _forbid_forwarding(uplink: str) -> None:
    """Let boards reach the operator and each other, and nothing behind the operator."""
    setting = Path(f"/proc/sys/net/ipv4/conf/{uplink}/forwarding")
    try:
        setting.write_text("0")
    except OSError as error:  # as in a container whose /proc/sys cannot be written
        if setting.read_text().strip() != "0":
            raise NetworkError(f"{uplink} would forward packets of boards: {error}") from error


def _make_namespace() -> int:
    """Return a descriptor of a new, empty network namespace."""
    child = os.fork()
    if child == 0:
        kernel.die_with_parent(os.getppid())
        kernel.unshare(kernel.CLONE_NEWNET)
        os.kill(os.getpid(), signal.SIGSTOP)
        os._exit(0)
    os.waitpid(child, os.WUNTRACED)
    try:
        return os.open(f"/proc/{child}/ns/net", os.O_RDONLY | os.O_CLOEXEC)
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def _run(
    command: Sequence[str],
    *,
    text: str = "",
    namespace: int | None = None,
    is_forced: bool = False,
) -> str:
    """Run a network tool, in the namespace of a descriptor, and return its output."""
    inside = [] if namespace is None else ["nsenter", f"--net=/proc/self/fd/{namespace}"]
    result = subprocess.run(
        [*inside, *command],
        input=text,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
        pass_fds=() if namespace is None else (namespace,),
    )
    if result.returncode and not is_forced:
        raise NetworkError(f"{' '.join(command)}: {result.stderr.strip()}\n{text}".strip())
    return result.stdout
