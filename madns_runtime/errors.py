"""The runtime's error tree. Blame is in the type: the user's file, the user's plug-in, a peer, the machine, ourselves."""

from __future__ import annotations


class MadnsError(Exception):
    """Any failure that the runtime foresees; its text says what was expected, what came, and what to do."""


class ConfigurationError(MadnsError):
    """A configuration or launch document is not what it should be; the user's file is to blame."""


class PluginError(MadnsError):
    """A plug-in cannot be found, does not keep its contract, or raised."""


class MissingExtraError(MadnsError):
    """
    An optional dependency is not installed; the message names the command that installs it.

    Args:
        module: What is missing.
        extra: Extra that brings it.
        distribution: Whose extra that is: a plug-in's own, or the runtime's.
    """

    def __init__(self, module: str, extra: str, distribution: str = "cosmos-madns") -> None:
        super().__init__(
            f"{module} is not installed here; install it with: pip install '{distribution}[{extra}]'"
        )
        self.module = module
        self.given = (module, extra, distribution)


class BlamedError(PluginError):
    """Code that a plug-in itself had called raised; the text says already whose, what, and in which line."""


class PeerError(MadnsError):
    """The other side did not do what was agreed."""


class MessageTooLarge(MadnsError):
    """A message does not fit its class of service; the sender's plug-in is to blame."""


class MachineError(MadnsError):
    """The machine refuses something: a taken port, a full disk, a missing permission."""


class IllegalTransition(MadnsError):
    """An event that the current state does not allow; the runtime itself is to blame."""
