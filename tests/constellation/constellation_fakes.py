"""A context without a runtime: a clock moved by hand, records in lists, jobs run when told."""

import math
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from madns_runtime.config import from_mapping
from madns_runtime.medium.carrier import Carrier
from madns_runtime.medium.mailbox import Mailbox
from madns_runtime.plugin.api import Tick
from madns_runtime.protocol.codec import decode_message, encode_message, pack, unpack
from madns_runtime.protocol.messages import Delivery, Transmission, TransmissionRefusal
from madns_runtime.recording.number_rows import NumberRows
from madns_runtime.simulations.constellation.agent import ConstellationAgent
from madns_runtime.simulations.constellation.host import ConstellationHost, radio_of
from madns_runtime.simulations.constellation.parameters import ConstellationParameters

SCENARIOS = Path(__file__).parents[2] / "scenarios"
WALKER = {"walker": "86.4:66/6/2", "altitude_km": 780.0}
IRIDIUM = {"elements": "data/iridium10.tle"}


def parameters(satellites=WALKER, **rest):
    return from_mapping(ConstellationParameters, {"satellites": satellites, **rest})


@dataclass
class FakeContext:
    name: str
    agents: tuple
    parameters: ConstellationParameters
    tick_hz: float = 10.0
    duration_s: float = 60.0
    workers: int = 1
    base_directory: Path = SCENARIOS
    clock_s: float = -1.0
    sent: list = field(default_factory=list)
    deadlines: list = field(default_factory=list)
    records: dict = field(default_factory=lambda: defaultdict(list))
    streams: dict = field(default_factory=dict)
    logs: list = field(default_factory=list)
    texts: dict = field(default_factory=dict)
    jobs: list = field(default_factory=list)
    is_lockstep: bool = False
    wake_s: float = math.inf
    random: np.random.Generator = field(default_factory=lambda: np.random.default_rng(7))
    transmitted: list = field(default_factory=list)
    hardware: dict = field(default_factory=dict)

    def __post_init__(self):
        self.mailbox = Mailbox(self.name, self.agents, has_medium=True, post=self._transmit)
        self.transmit, self.message_counts = self.mailbox.transmit, self.mailbox.counts
        self.carrier = Carrier(self.agents, self._hand_over, self.now_s)
        self.enter, self.account = self.carrier.enter, self.carrier.account

    def _transmit(self, transmission):
        self.transmitted.append((self.clock_s, travelled(transmission)))

    def _hand_over(self, to, message):
        self.sent.append((self.clock_s, to, travelled(message)))
        return True

    def now_s(self):
        return self.clock_s

    def send(self, to, message, service=None, *, deadline_s=None):
        self.sent.append((self.clock_s, to, unpack(pack(message))))
        if deadline_s is not None:
            self.deadlines.append((service, deadline_s))

    def open_stream(self, name, fields):
        # An agent that rejoins opens its streams anew; the host's half lives as long as the run.
        assert self.name != "host" or name not in self.streams, f"{name}: declared twice"
        self.streams[name] = tuple(fields)

    def record(self, stream, values):
        fields = self.streams[stream]
        assert len(values) == len(fields)
        rounded = NumberRows([field.digits for field in fields]).rounded(values)
        is_whole = all(field.digits is None for field in fields)
        self.records[stream].append(tuple(values if is_whole else rounded))

    def log(self, level, text):
        self.logs.append((level, text))

    def keep_text(self, name, data):
        self.texts[name] = self.texts.get(name, b"") + data

    def submit(self, function, *arguments):
        self.jobs.append((function, arguments))
        return len(self.jobs)

    def wake(self, t_s):
        self.wake_s = min(self.wake_s, t_s)


def travelled(message):
    return decode_message(encode_message(message))


def carry(host, context, name, transmission):
    """Give the host's medium what an agent sent to others, as the runtime does."""
    radio = radio_of(host, context)
    outcomes = radio.carry(name, transmission)
    radio.settled(name, transmission, context.carrier.enter(name, transmission, outcomes))
    context.carrier.hand_over()


def tell(agent, message):
    """Give an agent what came for it, as the runtime does."""
    if isinstance(message, Delivery):
        agent._context.mailbox.add(message)
    elif isinstance(message, TransmissionRefusal):
        agent.refused(message)
    else:
        agent.receive(message)


def tick(agent, tick):
    """Have an agent do a tick, as the runtime does."""
    for delivery in agent._context.mailbox.due(tick.t_s):
        agent.hear(delivery)
    agent.step(tick)


class Star:
    """
    One host and its agents on one simulated clock.

    Messages to agents take *delay_s(sent_s, agent)*, None loses one; those to the host take *up_s*.
    """

    def __init__(self, params, count=3, *, delay_s=None, **settings):
        names = tuple(f"agent-{n:02d}" for n in range(1, count + 1))
        self.context = FakeContext("host", names, params, **settings)
        self.delay_s = delay_s or (lambda sent_s, agent: 0.005)
        self.job_s = 0.01
        self.up_s = 0.005
        self.host = ConstellationHost()
        self.host.setup(self.context)
        self._done = 0
        self._run_jobs(all_now=True)
        self.contexts = {name: FakeContext(name, names, params, **settings) for name in names}
        self.agents = {}
        for name in names:
            self.join(name)
        self._mail = []
        self._up = []
        self._read = 0
        self._due_jobs = []

    def join(self, name):
        initial = unpack(pack(self.host.initial_data(name)))
        self.contexts[name].clock_s = self.context.clock_s
        agent = ConstellationAgent()
        agent.setup(self.contexts[name], initial)
        self.agents[name] = agent

    def run(self, until_s, *, from_s=0.0, step_s=0.01):
        """Move the clock; agents tick at their rate, the timer is called when it asked for it."""
        timer_s = from_s
        if from_s == 0.0:
            self.host.start(0.0)
        ratio = round(1.0 / self.context.tick_hz / step_s)
        for index in range(round(from_s / step_s), round(until_s / step_s)):
            t_s = index * step_s
            self.context.clock_s = t_s
            for context in self.contexts.values():
                context.clock_s = t_s
            self._run_jobs()
            while min(math.inf if timer_s is None else timer_s, self.context.wake_s) <= t_s:
                self.context.wake_s = math.inf
                timer_s = self.host.timer(t_s)
                assert timer_s is None or timer_s > t_s
            self.context.carrier.hand_over()
            self._deliver(t_s)
            self._hear(t_s)
            if index % ratio == 0:
                for agent in self.agents.values():
                    tick(agent, Tick(index // ratio, t_s, ratio * step_s, 0.0, 0))

    def summaries(self):
        return {name: agent.finish() for name, agent in self.agents.items()}

    def underruns(self):
        return sum(s["underruns"] for s in self.summaries().values())

    def _run_jobs(self, *, all_now=False):
        while self._done < len(self.context.jobs):
            if not all_now:
                if not self._due_jobs:
                    self._due_jobs.append(self.context.clock_s + self.job_s)
                if self.context.clock_s < self._due_jobs[0]:
                    return
                self._due_jobs.clear()
            function, arguments = self.context.jobs[self._done]
            self._done += 1
            self.host.result(self._done, function(*arguments))

    def _hear(self, t_s):
        for name, context in self.contexts.items():
            self._up += [(sent_s + self.up_s, name, message) for sent_s, _, message in context.sent]
            self._up += [(sent_s + self.up_s, name, one) for sent_s, one in context.transmitted]
            context.sent.clear()
            context.transmitted.clear()
        due = [mail for mail in self._up if mail[0] <= t_s]
        self._up = [mail for mail in self._up if mail[0] > t_s]
        for _, name, message in due:
            if isinstance(message, Transmission):
                carry(self.host, self.context, name, message)
            else:
                self.host.receive(name, message)

    def _deliver(self, t_s):
        for sent_s, to, message in self.context.sent[self._read :]:
            delay_s = self.delay_s(sent_s, to)
            if delay_s is not None:
                self._mail.append((sent_s + delay_s, to, message))
        self._read = len(self.context.sent)
        due = [mail for mail in self._mail if mail[0] <= t_s]
        self._mail = [mail for mail in self._mail if mail[0] > t_s]
        for _, to, message in sorted(due, key=lambda mail: mail[0]):
            if to in self.agents:
                tell(self.agents[to], message)


def state_rows(star, name):
    return np.array(star.contexts[name].records["state"])
