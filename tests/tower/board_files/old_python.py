"""Makes this interpreter say that it is Python 3.9; see README.md for what that is worth."""

import collections
import sys

_fields = collections.namedtuple("_fields", "major minor micro releaselevel serial")


class _VersionInfo(_fields):
    __slots__ = ()

    def __repr__(self) -> str:
        pairs = (f"{name}={value!r}" for name, value in zip(self._fields, self, strict=True))
        return f"sys.version_info({', '.join(pairs)})"


sys.version_info = _VersionInfo(3, 9, 2, "final", 0)  # type: ignore[assignment]
sys.hexversion = 0x030902F0
sys.version = "3.9.2 (default, " + sys.version.split("(", 1)[1].split(",", 1)[1].lstrip()
