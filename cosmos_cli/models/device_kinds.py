"""
Answers of kinds of devices: whether they are there, whether parameters suit them, what they measure and need.

Kinds that are not shipped with COSMoS are imported and asked in a process of their own, as simulations are.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import TypeAdapter, ValidationError

from cosmos_cli.errors import FAULTS_SHOWN_MAX, Fault
from cosmos_cli.models.document import Document
from cosmos_cli.models.document import Path as ValuePath
from cosmos_cli.models.parameters import adapter_of
from cosmos_cli.models.separate_process import (
    SeparateDefect,
    SeparateFailure,
    work_separately,
)
from cosmos_cli.models.text_forms import Requirement, SystemPackage, SystemUser, like
from cosmos_cli.models.translate import faults_of
from cosmos_cli.models.yaml_source import YamlSource
from madns_runtime.config import Timeouts, to_mapping
from madns_runtime.errors import MadnsError
from madns_runtime.hardware.contract import Channel, DeviceKind, Needs
from madns_runtime.hardware.kind_registry import GROUP, prepare, registered_kinds, resolve_kind
from madns_runtime.plain_values import from_mapping
from madns_runtime.plugin.code_places import blame
from madns_runtime.plugin.entry_points import registered
from madns_runtime.plugin.isolation import is_interruption, said
from madns_runtime.plugin.registry import is_file
from madns_runtime.plugin.time_limit import hold

SHIPPED = "madns_runtime."
"""Beginning of the modules whose code is ours."""

NEEDS_MAX = 64
"""Of each sort."""
_NEED_FORMS: Mapping[str, Any] = {
    "packages": SystemPackage,
    "groups": SystemUser,
    "boot_lines": Annotated[str, like(r"[^\r\n]*\S[^\r\n]*", "one line of text")],
    "files": Annotated[str, like(r"/[^\0\r\n]*", "an absolute path, or a pattern of it")],
    "requirements": Requirement,
    "system_modules": Annotated[
        str, like(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*", "the name of a Python module")
    ],
    "exclusive": Annotated[str, like(r"[^\0\r\n]*\S[^\0\r\n]*", "one line of text")],
}


@cache
def _need_form(name: str) -> TypeAdapter[str]:
    """Return what judges one sort of needs; made when a device is there to ask, for it takes milliseconds."""
    return TypeAdapter(_NEED_FORMS[name])


Tell = Callable[[str], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceQuestion:
    """One device, as an inventory or a scenario lists it."""

    path: ValuePath
    """Of its mapping within the document."""
    kind: str
    parameters: Mapping[str, Any]
    base_directory: Path
    """Folder from which files are found."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KindAnswer:
    """Answers of a kind to one device's parameters."""

    faults: tuple[Fault, ...] = ()
    """With any of them the rest is not known."""
    name: str = ""
    rate_hz: float = 1.0
    """Rate at which it is read where nobody says another, Hz."""
    rate_hz_max: float = 1.0
    needs_hardware: bool = False
    follows_simulated_time: bool = False
    channels: tuple[Channel, ...] = ()
    """Empty where only the parameters were asked about."""
    needs: Needs = dataclasses.field(default_factory=Needs)
    files: tuple[str, ...] = ()
    """Parameters that name a file which has to be there."""

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of what it measures."""
        return tuple(channel.name for channel in self.channels if channel.direction == "in")

    @property
    def has_outputs(self) -> bool:
        """Whether it moves anything."""
        return any(channel.direction == "out" for channel in self.channels)


def ask_kinds(
    questions: Sequence[DeviceQuestion],
    document: Document | None = None,
    *,
    limit_s: float | None = None,
    is_whole: bool = True,
) -> list[KindAnswer]:
    """
    Return what kinds say to devices, in the order of the questions.

    Args:
        questions: The devices.
        document: Where they stand; None where that is not known, and faults then have no line.
        limit_s: For a kind's code to come to an end, s; None for what a scenario gives that says nothing.
        is_whole: Whether channels and needs are asked for; they may depend on files of the parameters.
    """
    found: dict[int, KindAnswer] = {}
    for (kind, _), numbers in _by_kind(questions).items():
        asked = [questions[number] for number in numbers]

        def work(tell: Tell, asked: Sequence[DeviceQuestion] = asked) -> Mapping[str, Any]:
            return {"answers": [_answer(each, document, tell, is_whole) for each in asked]}

        try:
            if _is_shipped(kind):
                told = work(lambda stage: None)
            else:
                told = work_separately(work, limit_s=limit_s or Timeouts().loading_s)
            answers = [_from_plain(each) for each in told["answers"]]
        except SeparateFailure as failure:
            answers = [_wrong(document, each, ("kind",), str(failure)) for each in asked]
        except SeparateDefect as defect:
            raise RuntimeError(str(defect)) from None
        found |= dict(zip(numbers, answers, strict=True))
    return [found[number] for number in range(len(questions))]


def _by_kind(questions: Iterable[DeviceQuestion]) -> dict[tuple[str, Path], list[int]]:
    groups: dict[tuple[str, Path], list[int]] = {}
    for number, question in enumerate(questions):
        groups.setdefault((question.kind, question.base_directory), []).append(number)
    return groups


def _is_shipped(kind: str) -> bool:
    """Tell whether a kind's code is ours; nothing is imported."""
    if ":" in kind:
        return not is_file(kind) and kind.startswith(SHIPPED)
    entries = registered(GROUP).get(kind, ())
    return all(entry.startswith(SHIPPED) for entry in entries)  # none: nothing will be imported


def _answer(
    question: DeviceQuestion, document: Document | None, tell: Tell, is_whole: bool
) -> Mapping[str, Any]:
    """Ask here and now, and return plain values."""
    tell(f"importing the kind of device {question.kind}")
    try:
        with hold():
            kind = resolve_kind(question.kind, question.base_directory)
    except MadnsError as error:
        return _to_plain(_wrong(document, question, ("kind",), str(error)))
    except OSError as error:  # such as a name that is too long for a file
        text = f"not to be found: {error.strerror}"
        return _to_plain(_wrong(document, question, ("kind",), text))
    tell(f"making the parameters of {question.kind}")
    faults = _parameter_faults(kind, question, document)
    if faults:
        return _to_plain(KindAnswer(faults=tuple(faults)))
    answer = KindAnswer(
        name=kind.name,
        rate_hz=kind.rate_hz,
        rate_hz_max=kind.rate_hz_max,
        needs_hardware=kind.needs_hardware,
        follows_simulated_time=kind.follows_simulated_time,
        files=kind.files,
    )
    if not is_whole:
        return _to_plain(answer)
    tell(f"channels of {question.kind}")
    try:
        with hold():
            program = prepare(question.kind, question.parameters, question.base_directory)
    except MadnsError as error:
        inner = ("parameters",) if question.parameters else ("kind",)
        return _to_plain(_wrong(document, question, inner, str(error)))
    except BaseException as error:  # a kind's class may raise anything
        if is_interruption(error):
            raise
        text = f"{blame(error, kind.parameters)}: {said(error)}"
        return _to_plain(_wrong(document, question, ("kind",), text))
    if wrong := needs_faults(program.needs):
        text = f"{program.kind.name}: needs: {'; '.join(wrong)}"
        return _to_plain(_wrong(document, question, ("kind",), text))
    return _to_plain(
        dataclasses.replace(answer, channels=tuple(program.channels), needs=program.needs)
    )


def needs_faults(needs: Needs) -> list[str]:
    """Return what is wrong with the needs that a kind declares: they become commands on machines."""
    found = []
    for field in dataclasses.fields(Needs):
        items = getattr(needs, field.name)
        if len(items) > NEEDS_MAX:
            found.append(f"{field.name}: expected at most {NEEDS_MAX}, got {len(items)}")
            continue
        for item in items:
            try:
                _need_form(field.name).validate_python(item)
            except ValidationError as error:
                what = error.errors(include_url=False)[0]["msg"].removeprefix("Value error, ")
                found.append(f"{field.name}: {what}, got {item!r:.80}")
    return found


def _parameter_faults(
    kind: DeviceKind, question: DeviceQuestion, document: Document | None
) -> list[Fault]:
    """Return what the class of a kind's parameters finds wrong: names, types and bounds."""
    if kind.parameters is type(None):
        if not question.parameters:
            return []
        text = f"{kind.name} takes no parameters, got {', '.join(question.parameters)}"
        return list(_wrong(document, question, ("parameters",), text).faults)
    try:
        with hold():
            adapter_of(kind.parameters).validate_json(json.dumps(question.parameters), strict=True)
    except ValidationError as error:
        errors = error.errors(include_url=False)
        if document is None:
            placeless = Document(source=YamlSource.of("", ""), value=dict(question.parameters))
            found = faults_of(placeless, errors, kind.parameters)
            return [Fault(text=fault.text, path=f"parameters.{fault.path}") for fault in found]
        _mapping_at(document, question.path).setdefault("parameters", {})
        return faults_of(document, errors, kind.parameters, below=(*question.path, "parameters"))
    except MadnsError as error:
        return list(_wrong(document, question, ("kind",), str(error)).faults)
    except BaseException as error:  # a kind's class may raise anything
        if is_interruption(error):
            raise
        text = f"{blame(error, kind.parameters)}: {kind.parameters.__name__}: {said(error)}"
        return list(_wrong(document, question, ("kind",), text).faults)
    return []


def _wrong(
    document: Document | None, question: DeviceQuestion, inner: ValuePath, text: str
) -> KindAnswer:
    if document is None:
        return KindAnswer(faults=(Fault(text=text),))
    return KindAnswer(faults=(document.fault((*question.path, *inner), text),))


def _mapping_at(document: Document, path: ValuePath) -> dict[str, Any]:
    value: Any = document.value
    for step in path:
        value = value[step]
    found: dict[str, Any] = value
    return found


def _to_plain(answer: KindAnswer) -> Mapping[str, Any]:
    first = [dataclasses.asdict(fault.clipped()) for fault in answer.faults[:FAULTS_SHOWN_MAX]]
    channels = [to_mapping(channel) for channel in answer.channels]
    told = {each.name: getattr(answer, each.name) for each in dataclasses.fields(answer)}
    return {**told, "faults": first, "channels": channels, "needs": to_mapping(answer.needs)}


def _from_plain(told: Mapping[str, Any]) -> KindAnswer:
    return KindAnswer(
        **{
            **told,
            "faults": tuple(Fault(**values) for values in told["faults"]),
            "channels": tuple(from_mapping(Channel, each) for each in told["channels"]),
            "needs": from_mapping(Needs, told["needs"]),
            "files": tuple(told["files"]),
        }
    )


def describe_kinds() -> list[dict[str, Any]]:
    """Return all installed kinds with their summary and parameters, as plain values."""
    return [_description(name) for name in registered_kinds()]


def _description(name: str) -> dict[str, Any]:
    def work(tell: Tell) -> Mapping[str, Any]:
        tell(f"importing the kind of device {name}")
        try:
            with hold():
                kind = resolve_kind(name, Path())
        except MadnsError as error:
            return _described(name, fault=str(error))
        is_none = kind.parameters is type(None)
        parameters = (
            [] if is_none else [_parameter(each) for each in dataclasses.fields(kind.parameters)]
        )
        return _described(name, kind.summary, parameters)

    try:
        told = work(lambda stage: None) if _is_shipped(name) else None
        return dict(told or work_separately(work, limit_s=Timeouts().loading_s))
    except (SeparateFailure, SeparateDefect) as failure:
        return _described(name, fault=str(failure))


def _described(
    name: str, summary: str = "", parameters: Sequence[Mapping[str, Any]] = (), fault: str = ""
) -> dict[str, Any]:
    return {"kind": name, "summary": summary, "parameters": list(parameters), "fault": fault}


def _parameter(each: dataclasses.Field[Any]) -> dict[str, Any]:
    has_default = each.default is not dataclasses.MISSING
    has_factory = each.default_factory is not dataclasses.MISSING
    kind = each.type if isinstance(each.type, str) else getattr(each.type, "__name__", "value")
    return {
        "name": each.name,
        "type": kind,
        "required": not (has_default or has_factory),
        "default": repr(each.default) if has_default else None,
    }
