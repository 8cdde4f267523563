"""A radio medium with the framework's carrier around it: what is sent, what is handed over, and the account."""

from madns_runtime.medium.carrier import Carrier
from madns_runtime.protocol.messages import Delivery
from madns_runtime.simulations.constellation.truth.radio.channel import OUTCOMES


class Air:
    """
    Crosslinks or ground stations of vehicles, and what the carrier makes of what they answer.

    Args:
        medium: Its `carry` takes a vehicle's index.
        names: The vehicles'.
        channel: Whose account is asked for.
    """

    def __init__(self, medium, names, channel):
        self.medium, self._names, self._channel = medium, names, channel
        self._now_s = float("-inf")
        self._handed = []
        self._uplinked = []
        self.carrier = Carrier(names, self._hand_over, lambda: self._now_s)

    def send(self, sender, transmission, now_s):
        """Have a vehicle's message sent, of which the host hears at *now_s*; nothing is handed over yet."""
        self._now_s = now_s
        events = self.medium.carry(sender, transmission)
        self.carrier.enter(self._names[sender], transmission, events)
        return events

    def due(self, t_s):
        """Return receivers and what is handed over to them at *t_s*."""
        self._now_s = t_s
        for transmission, event in getattr(self.medium, "uplinks", lambda t_s: [])(t_s):
            self._uplinked.append(event)
            self.carrier.enter(event.sender, transmission, (event,))
        self.carrier.hand_over()
        handed, self._handed = self._handed, []
        return handed

    def contacts(self, t_s):
        return self.medium.contacts(t_s)

    def uplink_events(self):
        events, self._uplinked = self._uplinked, []
        return events

    def next_s(self):
        own = getattr(self.medium, "next_s", lambda: None)()
        return min((s for s in (own, self.carrier.next_s()) if s is not None), default=None)

    def summary(self):
        own = getattr(self.medium, "summary", dict)()
        return self.carrier.account(self._channel).to_mapping(OUTCOMES) | own

    def _hand_over(self, to, message):
        if isinstance(message, Delivery):
            self._handed.append((self._names.index(to), message))
        return True
