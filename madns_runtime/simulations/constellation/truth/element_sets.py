"""
Element sets from files: TLE, and OMM as CSV, JSON and XML.

Reading needs only the standard library, so that a scenario is validated quickly; sgp4 comes in when
a set is propagated (`sgp4_propagator`). Every fault of a file is reported at once with its line.
"""

from __future__ import annotations

import functools
import re
from pathlib import Path

from madns_runtime.bounded_files import FileRefused, read_regular_file
from madns_runtime.errors import ConfigurationError
from madns_runtime.simulations.constellation.truth.element_set import ElementSet
from madns_runtime.simulations.constellation.truth.omm_files import read_csv, read_json, read_xml
from madns_runtime.simulations.constellation.truth.tle_files import read_tle

FILE_BYTES_MAX = 64 * 1024 * 1024
"""The whole public catalogue as XML takes half of this."""
FAULTS_MAX = 20
"""Faults that one message lists; a file of another kind would give one per line."""
READERS = {"csv": read_csv, "json": read_json, "xml": read_xml, "tle": read_tle}
"""By kind of file."""
_KVN = re.compile(r"\s*CCSDS_OMM_VERS\s*=")
"""How an OMM as KVN begins."""


def read_element_sets(path: Path) -> tuple[ElementSet, ...]:
    """
    Read a file of element sets; OMM or TLE is told by suffix, else by content.

    Raises:
        ConfigurationError: The file is missing, too large, of no known kind, empty or faulty; one
            line a fault, each with file and line number.
    """
    return _parse(path, _read_text(path))


@functools.lru_cache(maxsize=2)  # check and labels ask for the same file
def _parse(path: Path, text: str) -> tuple[ElementSet, ...]:
    faults: list[str] = []
    sets = tuple(READERS[_kind(path, text)](text, str(path), faults))
    if faults:
        more = [f"{path}: and {len(faults) - FAULTS_MAX} more"] if len(faults) > FAULTS_MAX else []
        raise ConfigurationError("\n".join(faults[:FAULTS_MAX] + more))
    if not sets:
        raise ConfigurationError(f"{path}: expected TLE or OMM element sets, found none")
    return sets


def _read_text(path: Path) -> str:
    try:
        text = read_regular_file(path, bytes_max=FILE_BYTES_MAX).decode("utf-8-sig")
        return text.replace("\r\n", "\n").replace("\r", "\n")
    except FileNotFoundError as error:
        raise ConfigurationError(f"{path}: no such file") from error
    except FileRefused as error:
        raise ConfigurationError(str(error)) from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path}: cannot be read: {error}") from error


def _kind(path: Path, text: str) -> str:
    """
    Return the kind of a file, a key of READERS.

    Raises:
        ConfigurationError: It is an OMM as KVN.
    """
    if _KVN.match(text):
        raise ConfigurationError(
            f"{path}: expected TLE, or OMM as CSV, JSON or XML, got OMM as KVN (KEYWORD = value), which is not read; "
            "take the same sets in one of those forms"
        )
    suffix = path.suffix.lower()
    if suffix in (".csv", ".json", ".xml", ".tle"):
        return suffix[1:]
    head = text.lstrip()[:1]
    if head in ("[", "{"):
        return "json"
    if head == "<":
        return "xml"
    return "csv" if "MEAN_MOTION" in text.lstrip().partition("\n")[0] else "tle"
