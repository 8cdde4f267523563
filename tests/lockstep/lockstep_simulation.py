"""A simulation that uses all that lockstep promises something of, and does wrong what it is told to."""

import os
import signal
import sys
import time
from dataclasses import dataclass

from madns_runtime.plugin.api import HOST, AgentSimulation, HostSimulation, Simulation
from madns_runtime.protocol.messages import Service
from madns_runtime.recording.records import Field

WORK_S = 0.5
"""What a call that works needs of a processor."""
FORKED_S = 0.3
"""What a forked process that comes back from a call does before."""
SERVICES = (Service.BEST, Service.RELIABLE, Service.SYNC)


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters:
    fault: str = ""
    """What goes wrong: WHERE_WHAT, such as step_raise."""


def square(number):
    time.sleep(0.001 * (number % 3))  # later jobs are done before earlier ones
    if number < 0:
        raise ValueError("no such job")
    return number * number


def go_wrong(fault):
    what = fault.partition("_")[2]
    if what == "raise":
        raise ValueError("told to")
    if what == "hang":
        time.sleep(60)
    if what == "spin":
        while True:
            pass
    if what == "work":
        sys.stderr.write(f"working {os.getpid()} \n")
        sys.stderr.flush()
        began_s = time.process_time()
        while time.process_time() - began_s < WORK_S:
            pass
    if what == "stop":
        os.kill(os.getpid(), signal.SIGSTOP)
        time.sleep(60)
    if what == "pause":
        sys.stderr.write(f"paused {os.getpid()} \n")
        sys.stderr.flush()
        os.kill(os.getpid(), signal.SIGSTOP)
    if what == "idle":
        sys.stderr.write("idle\n")
        time.sleep(1.0)
    if what == "exit":
        os._exit(0)
    if what == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if what == "fork" and not os.fork():  # and neither process ends here
        time.sleep(FORKED_S)  # as on a busy machine: all that is left of the run takes less
    if what == "mute":
        sys.stderr = None
    if what == "term":
        os.kill(os.getpid(), signal.SIGTERM)


class Host(HostSimulation):
    def setup(self, context):
        self.context = context
        self.fault = context.parameters.fault
        self.meets("hostsetup")
        context.open_stream(
            "heard", (Field("t_s", "s"), Field("who", "", "str"), Field("what", "", "json"))
        )
        for number in range(6):
            context.submit(square, number)

    def meets(self, place):
        if self.fault.startswith(f"{place}_"):
            go_wrong(self.fault)

    def note(self, who, what):
        self.context.record("heard", (self.context.now_s(), who, what))

    def initial_data(self, agent):
        return {"number": self.context.agents.index(agent)}

    def start(self, t_s):
        self.note("start", t_s)

    def receive(self, agent, message):
        self.note(agent, message)
        if message[0] == "tick":
            self.meets("hostreceive")
            self.context.send(agent, ["answer", *message[1:]], SERVICES[message[1] % 3])
            if message[1] == 2:
                self.context.submit(square, 100 + self.context.agents.index(agent))

    def timer(self, t_s):
        self.note("timer", t_s)
        if t_s >= 0.2:
            self.meets("timer")
            self.fault = "" if self.fault == "timer_work" else self.fault
        if self.fault == "timer_same":
            return t_s
        if self.fault == "timer_stands":
            self.context.wake(t_s)
            return None
        if self.fault == "timer_drags":
            time.sleep(0.2)
            self.context.wake(t_s)
            return None
        if self.fault == "job_raise" and t_s >= 0.2:
            self.context.submit(square, -1)
        if self.fault == "job_kill" and t_s >= 0.2:
            self.context.submit(go_wrong, self.fault)
        if self.fault == "job_work" and 0.2 <= t_s < 0.23:
            self.context.submit(go_wrong, self.fault)
        if self.fault == "job_hang" and t_s >= 0.2:
            self.context.submit(time.sleep, 60)
        # The order of a set of names is the interpreter's own affair, unless that is settled.
        self.note("names", list(set(self.context.agents)))
        return t_s + 0.037

    def result(self, job, value):
        self.note("job", [job, value])

    def agent_lost(self, agent, reason):
        self.note("lost", [agent, reason])

    def agent_rejoined(self, agent):
        self.note("rejoined", agent)

    def finish(self):
        self.meets("hostfinish")
        self.context.submit(square, 12)  # too late: nothing is called any more
        for agent in self.context.agents if self.fault == "finish_say" else ():
            self.context.send(agent, ["bye"])
        return {"draws": self.context.random.random()}


class Agent(AgentSimulation):
    def setup(self, context, initial):
        self.context = context
        self.number = initial["number"]
        self.meets("setup")
        context.open_stream("own", (Field("t_s", "s"), Field("what", "", "json")))
        context.send(HOST, ["set up", context.is_lockstep])

    def meets(self, place):
        fault = self.context.parameters.fault
        if self.number == 3 and fault.startswith(f"{place}_"):
            go_wrong(fault)

    def step(self, tick):
        if tick.index == 2:
            self.meets("step")
            self.send_wrongly(self.context.parameters.fault)
            self.context.log("warning", f"draws {self.context.random.random()}")
        self.context.record("own", (self.context.now_s(), list(tick)))
        service = SERVICES[tick.index % 3]
        self.context.send(HOST, ["tick", tick.index, self.context.random.random()], service)

    def send_wrongly(self, fault):
        if self.number == 3 and fault == "send_set":
            self.context.send(HOST, {1, 2})
        if self.number == 3 and fault == "send_large":
            self.context.send(HOST, bytes(2000), Service.BEST)
        if fault == "send_late":
            self.context.send(HOST, "late", Service.SYNC, deadline_s=tick_before(self.context))

    def receive(self, message):
        self.meets("receive")
        self.context.record("own", (self.context.now_s(), message))
        if message[1] == 9:  # of the last tick: it comes when the simulated time is over
            self.context.send(HOST, ["last word", self.number])

    def abandon(self):
        self.context.keep_text("abandoned", b"once\n")

    def finish(self):
        self.meets("finish")
        if self.context.parameters.fault == "finish_say":
            self.context.send(HOST, ["bye"])
        return {"draws": self.context.random.random()}


def tick_before(context):
    return context.now_s() - 0.1


simulation = Simulation(name="lockstep", parameters=Parameters, host=":Host", agent=":Agent")
