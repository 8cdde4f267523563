"""
A stand-in for host and supervisor that speaks the operator's protocol and misbehaves as told.

How it behaves stands in COSMOS_FAKE, a JSON object: {"host": {...}, "agents": {...}}. A host runs for runs_s, or
until something is noted in COSMOS_FAKE_NOTES (runs_until), and an agent is killed likewise (agent_killed_after_s,
agent_killed_on): what must have happened by then takes as long as it takes.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import time

ROLE = sys.argv[1]
FAKE = json.loads(os.environ.get("COSMOS_FAKE", "{}")).get(ROLE, {})


class Line:
    def __init__(self, read_fd: int, write_fd: int) -> None:
        self.read_fd, self.write_fd = read_fd, write_fd
        self.rest = b""
        self.is_gone = False

    def say(self, event: str, **values: object) -> None:
        data = json.dumps({"event": event, **values}).encode() + b"\n"
        with contextlib.suppress(BrokenPipeError):  # `commands` notices that the operator is gone
            os.write(self.write_fd, data)

    def commands(self, timeout_s: float) -> list[dict]:
        if not select.select([self.read_fd], [], [], timeout_s)[0]:
            return []
        data = os.read(self.read_fd, 65536)
        self.is_gone = not data
        *lines, self.rest = (self.rest + data).split(b"\n")
        return [json.loads(line) for line in lines]

    def launch(self) -> tuple[dict, list[dict]]:
        while True:
            commands = self.commands(10)
            if commands:
                return commands[0], commands[1:]
            if self.is_gone:
                sys.exit(9)


def stubborn() -> None:
    if FAKE.get("ignores_sigterm"):
        signal.signal(signal.SIGTERM, signal.SIG_IGN)


def note(text: str) -> None:
    with open(os.environ["COSMOS_FAKE_NOTES"], "a") as notes:
        notes.write(f"{ROLE} {os.getpid()} {text}\n")


def is_noted(text: str) -> bool:
    with open(os.environ["COSMOS_FAKE_NOTES"]) as notes:
        return text in notes.read()


def is_over(t_s: float) -> bool:
    return is_noted(FAKE["runs_until"]) if "runs_until" in FAKE else t_s >= FAKE.get("runs_s", 0.3)


def is_agent_killed(t_s: float) -> bool:
    if "agent_killed_on" in FAKE:
        return is_noted(FAKE["agent_killed_on"])
    return FAKE.get("agent_killed_after_s", 1e9) < t_s


def host(line: Line) -> int:
    launch, pending = line.launch()
    note(f"launched {launch['directory']}")
    if FAKE.get("silent_start"):
        while not line.is_gone:
            line.commands(1)
        return 1
    if "dies_at_start" in FAKE:
        sys.stderr.write("Traceback (most recent call last):\nOSError: address already in use\n")
        return FAKE["dies_at_start"]
    line.say("listening", address="127.0.0.1", port=40001)
    line.say("state", state="SIMULATION_SETUP")
    line.say("state", state="SIMULATION_START")
    for index in range(FAKE.get("noise", 0)):
        os.write(line.write_fd, b"this is no event %d\n" % index)
    os.write(line.write_fd, FAKE.get("raw", "").encode())
    started_s = time.monotonic()
    status, reason = "complete", None
    while not is_over(time.monotonic() - started_s):
        t_s = time.monotonic() - started_s
        if not FAKE.get("is_silent"):
            line.say("progress", t_s=t_s, rtf=1.0, running=2, ticks=int(100 * t_s))
        for command in pending + line.commands(0.05):
            note(f"told {json.dumps(command)}")
            if command["command"] == "stop" and not FAKE.get("ignores_stop"):
                status, reason = command["status"], command["reason"]
            if command["command"] == "agent_exited" and not FAKE.get("ignores_exits"):
                status, reason = "failed", f"{command['agent']}: {command['how']}"
        pending = []
        if line.is_gone:
            note("life line gone")
            return 1
        if status != "complete":
            break
        if FAKE.get("killed_after_s", 1e9) < t_s:
            if FAKE.get("leaves_worker"):
                worker = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
                note(f"worker {worker.pid}")
            sys.stderr.write("last words of the host\n")
            sys.stderr.flush()
            os.kill(os.getpid(), signal.SIGKILL)
    finish(line, launch["directory"], {"status": status, "reason": reason})
    if FAKE.get("stays"):
        time.sleep(60)
    return 0 if status == "complete" else 1


def finish(line: Line, directory: str, told: dict) -> None:
    result = {**told, "agents": {}, "lost": []}
    if FAKE.get("leaves_result"):
        with open(os.path.join(directory, "result.json"), "w") as file:
            json.dump({**result, "left": True}, file)
    how = FAKE.get("finishes_with", "line")
    if how == "line":
        line.say("finished", result=result)
    elif how == "file":
        line.say("finished", result=None, file="result.json")
    elif how == "cut":
        os.write(line.write_fd, json.dumps({"event": "finished", "result": result}).encode()[:-9])
    elif how == "SIGKILL":
        os.kill(os.getpid(), signal.SIGKILL)


def agents(line: Line) -> int:
    launch, pending = line.launch()  # a run that is over meanwhile tells its stop with the launch
    note(f"launched {json.dumps(launch['agents'])} {launch['machine']} port {launch['host_port']}")
    for index, name in enumerate(launch["agents"]):
        line.say("started", agent=name, pid=1000 + index, incarnation=1)
    started_s = time.monotonic()
    exited = False
    while True:
        commands = pending + line.commands(0 if pending else 0.05)
        pending = []
        if line.is_gone and not FAKE.get("ignores_life_line"):
            note("life line gone")
            return 1
        if line.is_gone:
            time.sleep(0.05)
        t_s = time.monotonic() - started_s
        if not exited and is_agent_killed(t_s):
            exited = True
            values = {"agent": launch["agents"][0], "pid": 1000, "code": None, "signal": "SIGKILL"}
            line.say("exited", **values, how="killed by SIGKILL", will_restart=False)
        if FAKE.get("killed_after_s", 1e9) < t_s:
            os.kill(os.getpid(), signal.SIGKILL)
        if any(command["command"] == "stop" for command in commands):
            note("stopped")
            if FAKE.get("ignores_stop"):
                continue
            for name in launch["agents"]:
                values = {"agent": name, "pid": 1000, "code": 0, "signal": None}
                line.say("exited", **values, how="ended", will_restart=False)
            line.say("finished")
            return 0


def main() -> int:
    stubborn()
    if "--launch" in sys.argv:
        connection = socket.socket(socket.AF_UNIX)
        connection.connect(sys.argv[-1])
        fd = connection.detach()
        return agents(Line(fd, fd))
    return {"host": host, "agents": agents}[ROLE](Line(0, 1))


sys.exit(main())
