"""MADNS: the real-time framework below COSMoS. It knows hosts, agents, ticks and messages, and no satellites."""

__version__ = "0.1.0"
