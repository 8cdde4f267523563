"""Checks of the network between a machine and this computer. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from cosmos_cli.doctor.case import Case
from cosmos_cli.doctor.finding import CheckRemark, Severity
from cosmos_cli.fleet.connection import NO_ADDRESS, NO_ADDRESS_CURE
from madns_runtime.protocol.datagram import DATAGRAM_BYTES_MAX

CAP_NET_ADMIN = 12
IP_UDP_BYTES = 28
SPEED_MBIT_MIN = 100
ERROR_SHARE_WARNING = 1e-6
ROUND_TRIP_MS_NOTE = 5.0


def receive_buffer(case: Case) -> Iterator[CheckRemark]:
    """A burst of datagrams from many agents must fit: a small buffer loses most of it."""
    limit_bytes = case.facts.network.receive_buffer_bytes_max
    wanted_bytes = case.wants.receive_buffer_bytes
    if limit_bytes is None:
        return
    if limit_bytes >= wanted_bytes or case.has_capability(CAP_NET_ADMIN):
        yield CheckRemark(found=f"UDP receive buffer of {wanted_bytes} bytes is granted")
    else:
        yield CheckRemark(
            level=Severity.WARNING,
            found=f"UDP receive buffer of {limit_bytes} bytes at most: {wanted_bytes} are asked for",
            cure=case.cure(
                f"cosmos_receive_buffer_bytes: {wanted_bytes}",
                f"echo net.core.rmem_max={wanted_bytes} | sudo tee /etc/sysctl.d/90-cosmos.conf"
                " && sudo sysctl --system",
            ),
        )


def receive_drops(case: Case) -> Iterator[CheckRemark]:
    """Datagrams that came and found no room."""
    told = case.part("receive_drops")
    total, before = told.get("total"), told.get("before")
    if total is None:
        return
    is_new = before is not None and total > before
    level = (Severity.WARNING if is_new else Severity.NOTE) if total else Severity.OK
    yield CheckRemark(
        level=level,
        found="datagrams dropped by full receive buffers, of any program since it was started",
        cure="a larger receive buffer (`receive_buffer` tells)" if total else "",
        figure=total,
    )


def link(case: Case) -> Iterator[CheckRemark]:
    """Speed and duplex."""
    for item in _interfaces(case):
        name, speed, duplex = item["name"], item.get("speed_mbit"), item.get("duplex")
        if duplex == "half":
            yield CheckRemark(
                level=Severity.ERROR,
                found=f"{name} is half-duplex: it cannot send while it receives",
                cure="another cable or port of the switch; both ends must negotiate by themselves",
            )
        elif speed and 0 < speed < SPEED_MBIT_MIN:
            yield CheckRemark(
                level=Severity.WARNING,
                found=f"{name} is slow: expected {SPEED_MBIT_MIN} Mbit/s or more",
                cure="another cable or port of the switch",
                figure=speed,
                unit="Mbit/s",
            )
        elif speed and speed > 0:
            yield CheckRemark(
                found=f"{name}, {duplex or 'unknown'} duplex", figure=speed, unit="Mbit/s"
            )


def link_errors(case: Case) -> Iterator[CheckRemark]:
    """Frames that were damaged on their way."""
    for item in _interfaces(case):
        errors, packets = item.get("errors") or 0, item.get("packets") or 0
        is_bad = errors > 0 and (
            bool(item.get("new_errors")) or errors > ERROR_SHARE_WARNING * max(1, packets)
        )
        level = (Severity.WARNING if is_bad else Severity.NOTE) if errors else Severity.OK
        yield CheckRemark(
            level=level,
            found=f"{item['name']}: errors since it was started",
            cure="another cable or port of the switch" if errors else "",
            figure=errors,
            detail=f"{packets} packets" if errors else "",
        )


def mtu(case: Case) -> Iterator[CheckRemark]:
    """A datagram that does not fit is cut in two, and lost when either is."""
    for item in _interfaces(case):
        found = item.get("mtu")
        needed = DATAGRAM_BYTES_MAX + IP_UDP_BYTES
        if found is None:
            continue
        is_small = found < needed
        yield CheckRemark(
            level=Severity.WARNING if is_small else Severity.OK,
            found=f"{item['name']}: MTU" + (f": datagrams need {needed}, got" if is_small else ""),
            cure=case.cure_by(f"ip link set {item['name']} mtu 1500") if is_small else "",
            figure=found,
        )


def wifi(case: Case) -> Iterator[CheckRemark]:
    """Wi-Fi loses and delays; saving power, it delays every packet up to a beacon's interval."""
    for item in filter(lambda item: item.get("is_wireless"), _interfaces(case)):
        yield CheckRemark(
            level=Severity.WARNING,
            found=f"reached over Wi-Fi ({item['name']}): delays and losses are not those of a cable",
            cure="a cable",
        )
        if item.get("saves_power"):
            yield CheckRemark(
                level=Severity.WARNING,
                found=f"{item['name']} saves power: packets wait up to 100 ms and more",
                cure=case.cure_by(f"iw dev {item['name']} set power_save off"),
            )


def udp(case: Case) -> Iterator[CheckRemark]:
    """Datagrams to this computer and back, as agents and host exchange them."""
    told = case.part("round_trips")
    if not told:
        if not case.is_here:
            yield CheckRemark(
                level=Severity.WARNING, found=f"UDP not tested: {NO_ADDRESS}", cure=NO_ADDRESS_CURE
            )
        return
    where = f"{told['address']}:{told['port']}"
    sent, answered = told["sent"], told["answered"]
    if told.get("error"):
        yield CheckRemark(
            level=Severity.ERROR,
            found=f"cannot send UDP to {told['address']}: {told['error']}",
            cure="`cosmos_host_address` in the inventory says by which address this computer is reached",
        )
    elif not answered:
        yield CheckRemark(
            level=Severity.ERROR,
            found=f"no UDP from there to this computer ({told['address']})",
            cure=_firewall_cure(case),
            detail=f"{sent} datagrams to {where}",
        )
    elif answered < sent:
        yield CheckRemark(
            level=Severity.WARNING,
            found=f"of {sent} datagrams to this computer and back were lost",
            cure="cables, the switch, and who else uses the network (`link`, `link_errors` tell)",
            figure=sent - answered,
        )
        yield _trip(told, Severity.OK)
    else:
        yield _trip(told, Severity.NOTE if told["p50_ms"] > ROUND_TRIP_MS_NOTE else Severity.OK)


def _trip(told: Mapping[str, Any], level: Severity) -> CheckRemark:
    return CheckRemark(
        level=level,
        found=f"round trip of {told['sent']} datagrams to this computer: median",
        cure=""
        if level == Severity.OK
        else "a shorter way; a lead of maneuvers and buffers that allow for it"
        " (`cosmos plan --latency-ms`)",
        figure=told["p50_ms"],
        unit="ms",
        detail=f"shortest {told['min_ms']:.3g} ms, longest {told['max_ms']:.3g} ms",
    )


def _firewall_cure(case: Case) -> str:
    port = case.wants.port
    which = (
        f"UDP port {port}"
        if port
        else "UDP (or set network.port in the scenario, and open that one)"
    )
    return (
        f"open {which} in this computer's firewall for the machines' network;"
        " `cosmos_host_address` names another address of this computer"
    )


def udp_unasked(case: Case) -> Iterator[CheckRemark]:
    """Datagrams that the machine had not asked for; only a host needs them."""
    came = case.part("round_trips").get("unasked")
    if came is None or case.is_here:
        return
    if came:
        yield CheckRemark(
            found="takes datagrams that it did not ask for: it could be the run's host"
        )
    else:
        yield CheckRemark(
            level=Severity.NOTE,
            found="a firewall there keeps out datagrams that it did not ask for: agents need none,"
            " the host of a run does",
            cure="only for `cosmos run --host`: open UDP there for the other machines",
        )


def _interfaces(case: Case) -> list[Mapping[str, Any]]:
    return list(case.told.get("interfaces") or ())
