"""
A host certificate of OpenSSH, and whether it proves a machine's name. Pure: the caller judges its authority.

Form: PROTOCOL.certkeys of OpenSSH. A certificate without principals stands for every name, as ssh has it.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

from paramiko.message import Message
from paramiko.pkey import PKey, UnknownKeyType
from paramiko.ssh_exception import SSHException

from cosmos_cli.fleet.ssh.known_hosts import HostKey

HOST_CERTIFICATE = 2
KEY_FIELDS = {"ssh-ed25519": 1, "ssh-rsa": 2}
"""Of the public key in the certificate; those of ecdsa are 2 as well: its curve and the point."""

SHA_1_SIGNATURES = ("ssh-rsa", "ssh-dss")
"""Forms of a signature that ssh takes of no authority (CASignatureAlgorithms)."""
YEAR_9999_S = 253_370_764_800
"""Latest time that datetime can tell; for ever is later."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HostCertificate:
    """Content of a certificate that an authority has signed."""

    kind: int
    principals: tuple[str, ...]
    """Names that the key is for."""
    valid_after_s: int
    valid_before_s: int
    """Unix time."""
    critical_options: bytes
    authority: HostKey
    signed: bytes
    signature: bytes

    def fault(self, name: str, now_s: float) -> str | None:
        """
        Return why it does not prove that its key belongs to a machine; None when it does.

        Args:
            name: Host name or address, without a port, in small letters.
            now_s: Unix time.
        """
        algorithm = Message(self.signature).get_binary().decode("ascii", "replace")
        if algorithm in SHA_1_SIGNATURES:
            return f"it is signed by SHA-1 ({algorithm}), which can be forged"
        if not self._is_signed():  # first: of one that is forged nothing is worth telling
            return f"its signature by a key {self.authority.kind} is not valid, or not understood"
        if self.kind != HOST_CERTIFICATE:
            return "it is a certificate of a user, not of a host"
        if self.critical_options:
            return "it has critical options, and none is known for hosts"
        if self.principals and name not in (principal.lower() for principal in self.principals):
            return f"it is for {', '.join(self.principals)}, not for {name}"
        if now_s < self.valid_after_s:
            return f"it is not valid before {_utc(self.valid_after_s)}"
        if now_s >= self.valid_before_s:
            return f"it has expired on {_utc(self.valid_before_s)}"
        return None

    def _is_signed(self) -> bool:
        try:
            key = PKey.from_type_string(self.authority.kind, self.authority.blob)
            return bool(key.verify_ssh_sig(self.signed, Message(self.signature)))
        except (SSHException, UnknownKeyType, ValueError):  # such as one on a security token
            return False


def read_certificate(blob: bytes) -> HostCertificate:
    """
    Read what a machine shows in the place of a plain key.

    Raises:
        ValueError: It has another form.
    """
    message = Message(blob)
    kind = message.get_text().partition("-cert-")[0]
    message.get_binary()  # a nonce
    for _ in range(KEY_FIELDS.get(kind, 2)):
        message.get_binary()
    message.get_int64()  # its serial number
    certified = message.get_int()
    message.get_binary()  # its name, for logs
    names = Message(message.get_binary())
    principals = []
    while names.get_remainder():
        principals.append(names.get_text())
    valid_after_s, valid_before_s = message.get_int64(), message.get_int64()
    critical_options = message.get_binary()
    for _ in ("extensions", "reserved"):
        message.get_binary()
    authority = message.get_binary()
    signed = message.get_so_far()
    signature = message.get_binary()
    if message.get_remainder() or signed + Message().add_string(signature).asbytes() != blob:
        raise ValueError("expected a certificate that ends with its signature")
    return HostCertificate(
        kind=certified,
        principals=tuple(principals),
        valid_after_s=valid_after_s,
        valid_before_s=valid_before_s,
        critical_options=critical_options,
        authority=HostKey(kind=Message(authority).get_text(), blob=authority),
        signed=signed,
        signature=signature,
    )


def _utc(time_s: int) -> str:
    return f"{datetime.fromtimestamp(min(time_s, YEAR_9999_S), UTC):%Y-%m-%d %H:%M:%S} UTC"
