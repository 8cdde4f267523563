"""
Questions to a simulation, asked here if it is shipped with COSMoS, else in a process of its own.

Code of somebody's own may hang, or end the process.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from cosmos_cli.models.document import Document
from cosmos_cli.models.parameters import adapter_of
from cosmos_cli.models.separate_process import SeparateDefect, work_separately
from madns_runtime import errors as runtime_errors
from madns_runtime.config import Timeouts, from_mapping, to_mapping
from madns_runtime.errors import MadnsError, MissingExtraError, PluginError
from madns_runtime.plain_values import is_real
from madns_runtime.plugin.queries import import_questions
from madns_runtime.plugin.registry import is_shipped, resolve

_CODE = re.compile(r"[\w./~-]+:[A-Za-z_]\w*")
"""Form in which a parameter names code of one's own: guidance.py:Guidance, package.module:Class."""

Tell = Callable[[str], None]
T = TypeVar("T")


def ask_apart(work: Callable[[Tell], T], kind: type[T], document: Document, spec: str) -> T:
    """Return what *work* does: here if the simulation is shipped, else in a process of its own."""
    settings = [document.value.get(key) for key in ("parameters", "agent_parameters")]
    if is_shipped(spec):
        if not _names_code(settings):
            return work(lambda doing: None)
        _prepare(spec)

    def guarded(tell: Tell) -> Mapping[str, Any]:
        try:
            return {"value": to_mapping(work(tell))}
        except MissingExtraError as error:
            return {"missing": error.given}
        except MadnsError as error:
            return {"raised": [type(error).__name__, str(error)]}

    try:
        answer = work_separately(guarded, limit_s=_limit_s(document))
    except SeparateDefect as defect:
        raise RuntimeError(str(defect)) from None
    if "missing" in answer:
        raise MissingExtraError(*answer["missing"])
    if "raised" in answer:
        name, text = answer["raised"]
        raise getattr(runtime_errors, name, PluginError)(text)
    return from_mapping(kind, answer["value"])


def _prepare(spec: str) -> None:
    """Import and make what a shipped simulation is asked with: here once, in place of once in each fork."""
    with contextlib.suppress(MadnsError, ImportError):  # whoever asks is told what is wrong with it
        simulation = resolve(spec, Path())
        import_questions(simulation)
        adapter_of(simulation.parameters)


def _limit_s(document: Document) -> float:
    """Return what the scenario gives its plug-in, as far as that can be told yet."""
    timeouts = document.value.get("timeouts")
    value = timeouts.get("loading_s") if isinstance(timeouts, dict) else None
    if is_real(value) and 0 < value <= 3600:
        return float(value)
    return Timeouts().loading_s


def _names_code(value: Any) -> bool:
    if isinstance(value, str):
        return _CODE.fullmatch(value) is not None
    if isinstance(value, dict):
        return any(map(_names_code, value.values()))
    return isinstance(value, list) and any(map(_names_code, value))
