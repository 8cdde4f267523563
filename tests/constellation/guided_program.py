"""
Flight software for tests: one guidance, in any protocol and over any transport, with the standard library alone.

    python guided_program.py PROTOCOL TRANSPORT [ADDRESS]
"""

import binascii
import json
import math
import os
import socket
import struct
import sys
import zlib

MU_M3_S2 = 398600441500000.0


class Guidance:
    def __init__(self):
        self.settings = {}
        self.next_s = 0.0

    def step(self, t_s, gnss):
        """Return estimates and delta-v of a tick."""
        if gnss is None:
            return None, None
        x, y, z, vx, vy, vz = gnss
        distance_m = math.sqrt(x * x + y * y + z * z)
        speed_m_s = math.sqrt(vx * vx + vy * vy + vz * vz)
        a_m = 1.0 / (2.0 / distance_m - speed_m_s * speed_m_s / MU_M3_S2)
        wanted_m = self.settings["a_m"]
        estimate = {"a_m": a_m, "a_error_m": a_m - wanted_m}
        if abs(a_m - wanted_m) <= self.settings["tolerance_m"] or t_s < self.next_s:
            return estimate, None
        dv_m_s = MU_M3_S2 * (wanted_m - a_m) / (2.0 * a_m * a_m * speed_m_s)
        lead_s = self.settings["lead_s"]
        self.next_s = t_s + lead_s + 2.0
        return estimate, (dv_m_s, t_s + lead_s)


class Lines:
    def __init__(self, guidance):
        self.guidance = guidance
        self.rest = b""

    def feed(self, data):
        *lines, self.rest = (self.rest + data).split(b"\n")
        for told in map(json.loads, lines):
            if "setup" in told:
                self.guidance.settings = told["setup"]["settings"]
                continue
            gnss = told["readings"].get("gnss", {}).get("values")
            estimate, command = self.guidance.step(told["t_s"], gnss)
            answer = {"t_s": told["t_s"], "estimate": estimate}
            if command:
                answer["commands"] = [{"delta_v_m_s": [0.0, command[0], 0.0], "at_s": command[1]}]
            yield json.dumps(answer).encode() + b"\n"


class Structs:
    order = "<"

    def __init__(self, guidance):
        self.guidance = guidance
        self.rest = b""
        self.gnss = None
        self.counts = {}

    def feed(self, data):
        for number, t_s, body in self.cut(data):
            if number == 2:
                value, _, _, _, name, _ = struct.unpack(f"{self.order}dHHB3x32s48s", body)
                self.guidance.settings[name.rstrip(b"\0").decode()] = value
            elif number == 3 and body[8] == 1:
                self.gnss = struct.unpack(f"{self.order}6d", body[16:])
            elif number == 7:
                yield b"".join(self.answer(t_s))

    def answer(self, t_s):
        estimate, command = self.guidance.step(t_s, self.gnss)
        self.gnss = None
        for name, value in (estimate or {}).items():
            yield self.wrap(134, t_s, struct.pack(f"{self.order}d32s", value, name.encode()))
        if command:
            dv_m_s, at_s = command
            body = struct.pack(f"{self.order}4dB7x", 0.0, dv_m_s, 0.0, at_s, 1)
            yield self.wrap(129, t_s, body)
        yield self.wrap(136, t_s, struct.pack(f"{self.order}Q", 7))


class Frames(Structs):
    def cut(self, data):
        *frames, self.rest = (self.rest + data).split(b"\0")
        for stuffed in frames:
            out, place = bytearray(), 0
            while place < len(stuffed):
                code = stuffed[place]
                out += stuffed[place + 1 : place + code]
                place += code
                if code < 255 and place < len(stuffed):
                    out.append(0)
            assert zlib.crc32(out[:-4]) == int.from_bytes(out[-4:], "little")
            yield out[0], struct.unpack_from("<d", out, 8)[0], bytes(out[16:-4])

    def wrap(self, number, t_s, body):
        sequence = self.counts["all"] = (self.counts.get("all", -1) + 1) & 0xFFFF
        whole = struct.pack("<BBHHHd", number, 1, sequence, len(body), 0, t_s) + body
        whole += zlib.crc32(whole).to_bytes(4, "little")
        parts = (bytes([len(part) + 1]) + part for part in whole.split(b"\0"))
        return b"".join(parts) + b"\0"


class Packets(Structs):
    order = ">"

    def cut(self, data):
        self.rest += data
        while len(self.rest) >= 6:
            first, _, length = struct.unpack_from(">HHH", self.rest)
            size = 7 + length
            if len(self.rest) < size:
                return
            packet, self.rest = self.rest[:size], self.rest[size:]
            assert binascii.crc_hqx(packet, 0xFFFF) == 0
            yield (first & 0x7FF) - 256, struct.unpack_from(">d", packet, 6)[0], packet[14:-2]

    def wrap(self, number, t_s, body):
        count = self.counts[number] = (self.counts.get(number, -1) + 1) & 0x3FFF
        data = struct.pack(">d", t_s) + body
        whole = struct.pack(">HHH", 0x0800 | 256 + number, 0xC000 | count, len(data) + 1) + data
        return whole + binascii.crc_hqx(whole, 0xFFFF).to_bytes(2, "big")


PROTOCOLS = {"json_lines": Lines, "frames": Frames, "space_packets": Packets}


def opened(transport, address):
    """Return functions that read and write."""
    if transport == "stdio":
        return (lambda: os.read(0, 65536)), (lambda data: os.write(1, data))
    if transport in ("pty", "serial"):
        fd = os.open(address, os.O_RDWR | os.O_NOCTTY)
        return (lambda: os.read(fd, 65536)), (lambda data: os.write(fd, data))
    if transport == "unix":
        one = socket.socket(socket.AF_UNIX)
        one.connect(address)
    else:
        host, _, port = address.rpartition(":")
        kind = socket.SOCK_DGRAM if transport == "udp" else socket.SOCK_STREAM
        one = socket.socket(socket.AF_INET, kind)
        one.connect((host, int(port)))
        if transport == "udp":
            one.send(b"")
    return (lambda: one.recv(65536)), one.send


def main(protocol, transport, address=""):
    read, write = opened(transport, address)
    software = PROTOCOLS[protocol](Guidance())
    while True:
        try:
            data = read()
        except OSError:  # the other end of a terminal is gone
            return
        if not data:
            return
        for answer in software.feed(data):
            write(answer)


if __name__ == "__main__":
    main(*sys.argv[1:])
