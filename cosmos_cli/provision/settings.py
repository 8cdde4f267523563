"""
The plan of settings, of which `cosmos_cli.models.inventory.settings` has the table. Pure.

What was there before is remembered on the machine before anything changes, and put back when the inventory
no longer asks for the setting. A machine has one file of each setting, but perhaps several users and folders of COSMoS,
each with a memory of its own: the file names the one that wrote it, and nobody else takes it away.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.models.inventory.settings import SETTINGS, Setting
from cosmos_cli.models.machine_facts import FileFact, MachineFacts
from cosmos_cli.provision.desired import DesiredState
from cosmos_cli.provision.step import Change, Kind, Step, StepRequest

HEADER = "# Written by `cosmos up` for {variable}; it takes it away when the inventory no longer asks for it.\n"
CLAIM = "# for "
"""Begin of the lines below the header that name a user and a folder of COSMoS; older versions wrote none."""
MEMORY_SCHEMA = 1


def setting_steps(facts: MachineFacts, desired: DesiredState) -> Iterator[Step]:
    """
    Yield a step for each setting that is to be made, changed, or put back.

    Raises:
        MachineFailure: One cannot be made or put back, or what was before is not readable any more.
    """
    plan = _Plan(facts=facts, desired=desired, memory=read_memory(facts.file(desired.memory_path)))
    for setting in SETTINGS:
        value = getattr(desired.variables, setting.variable)
        yield from plan.make(setting, value) if value is not None else plan.put_back(setting)


def read_memory(fact: FileFact) -> dict[str, Any]:
    """
    Return what the machine remembers of the time before, by setting.

    Raises:
        MachineFailure: It is damaged, or a newer program wrote it.
    """
    if fact.kind == "missing":
        return {}
    schema: Any = None
    try:
        document = json.loads(fact.text or "")
        schema = document["schema"]
        if schema == MEMORY_SCHEMA and isinstance(document["settings"], dict):
            return dict(document["settings"])
    except (ValueError, KeyError, TypeError, RecursionError):
        pass
    if isinstance(schema, int) and schema > MEMORY_SCHEMA:
        raise MachineFailure(
            FailureKind.DATA,
            "state/settings.json in COSMoS's folder there, which remembers what settings were before,"
            f" is of a newer COSMoS (schema {schema}, this one knows {MEMORY_SCHEMA})",
            "use that version for this machine, or upgrade cosmos-madns here",
        )
    raise MachineFailure(
        FailureKind.DATA,
        "state/settings.json in COSMoS's folder there, which remembers what settings were before,"
        " is damaged",
        "remove it; then what is set now counts as what was before",
    )


@dataclass(slots=True)
class _Plan:
    """Plans one setting after the other; each step's memory holds what those before it remembered."""

    facts: MachineFacts
    desired: DesiredState
    memory: dict[str, Any]

    def make(self, setting: Setting, value: Any) -> Iterator[Step]:
        path, text, found = self._file_of(setting, value)
        if self._is_said(setting, found.text, text):
            text = found.text or ""
        live = setting.live(self.facts, self.desired.paths)
        wish = setting.wish(value)
        different = [[where, wish] for where, present in live.items() if present != wish]
        if found.text == text and not different:
            return
        refusal = setting.refusal(value, self.facts)
        if refusal is not None:
            raise MachineFailure(FailureKind.UNSUPPORTED, *refusal)
        requests = []
        if setting.key not in self.memory:
            is_leftover = _is_ours(setting, found.text) and not self._is_of_another(setting, found)
            former = None if is_leftover else found.text
            self.memory[setting.key] = {"file": former, "values": live}
            requests.append(self._remember())
        if found.text != text:
            requests.append(_write(path, text))
        if different:
            requests.append(_set(different))
        before = _shown(setting, live.values()) or ("set otherwise" if found.text else "not set")
        is_kept = bool(live) and not different
        how = "keep" if is_kept else f"{before} ->"
        after = " after a restart, too" if is_kept else ""
        yield Step(
            kind=Kind.SETTING,
            title=f"setting {setting.variable}: {how} {_value_words(value)}{after}",
            requests=tuple(requests),
            subject=setting.key,
            change=Change(path=path, before=found.text, after=text),
        )

    def put_back(self, setting: Setting) -> Iterator[Step]:
        path, others, found = self._file_of(setting, None)
        known = self.memory.get(setting.key)
        is_of_another = self._is_of_another(setting, found)
        is_left = _is_ours(setting, found.text) and found.text != others and not is_of_another
        if known is None and not is_left:
            return
        if known is not None and is_of_another:
            yield self._leave(setting, path, found)
            return
        before = others or (known or {}).get("file")
        values = self._former_values(setting, (known or {}).get("values") or {})
        for _, value in values:
            if (refusal := setting.put_back_refusal(value, self.facts)) is not None:
                raise MachineFailure(FailureKind.UNSUPPORTED, *refusal)
        requests = []
        if values:
            requests.append(_set(values))
        if before is not None and found.text != before:
            requests.append(_write(path, before))
        elif before is None and found.kind == "file":
            requests.append(StepRequest(verb="remove_file", arguments={"path": path}, as_root=True))
        if known is not None:
            del self.memory[setting.key]
            requests.append(self._remember())
        shown = _shown(setting, (value for _, value in values))
        how = f"put back {shown}" if shown else "take away"
        yield Step(
            kind=Kind.SETTING,
            title=f"setting {setting.variable}: {how}",
            requests=tuple(requests),
            subject=setting.key,
            change=Change(path=path, before=found.text, after=before),
        )

    def _file_of(self, setting: Setting, value: Any) -> tuple[str, str, FileFact]:
        """Return the path of a setting's file, its text for a value, or for others alone, and what it is now."""
        path = setting.file(self.desired.paths)
        found = self.facts.file(path)
        if found.kind in ("directory", "other") or (found.kind == "file" and found.text is None):
            text = f"{path}: expected a small file of text, or none"
            raise MachineFailure(FailureKind.STEP, text, "remove it there")
        lines, claims = self._lines_of_others(setting, found.text)
        if value is not None:
            lines.append(setting.line(value, self.facts))
            claims.append(f"{self.facts.user} {self.desired.layout.root}")
        told = [*(CLAIM + claim for claim in sorted(claims)), *sorted(lines)]
        text = _head(setting) + "".join(f"{line}\n" for line in told)
        return path, text if lines else "", found

    def _lines_of_others(self, setting: Setting, text: str | None) -> tuple[list[str], list[str]]:
        """Return what the file holds for other logins, and their claims: it is one for all of them."""
        lines = (text or "").splitlines() if _is_ours(setting, text) else ()
        said = (line for line in lines if line.strip() and not line.startswith("#"))
        claims = (claim for claim in _claims(text) if not setting.is_own(claim, self.facts))
        return [line for line in said if not setting.is_own(line, self.facts)], [*claims]

    def _claim(self, setting: Setting, text: str | None) -> str | None:
        """Return the user and the folder that a file names as its own; None if it names none, as of older versions."""
        claims = _claims(text) if _is_ours(setting, text) else ()
        return next((claim for claim in claims if setting.is_own(claim, self.facts)), None)

    def _is_of_another(self, setting: Setting, found: FileFact) -> bool:
        """Tell whether a file is another's: of another folder, or, where nothing is remembered here, of another user."""
        claim, root = self._claim(setting, found.text), self.desired.layout.root
        if claim is None:
            return False
        is_known = setting.key in self.memory  # a user whose name changed has the same memory
        return claim.partition(" ")[2] != root or not (
            is_known or claim == f"{self.facts.user} {root}"
        )

    def _is_said(self, setting: Setting, found: str | None, text: str) -> bool:
        """
        Tell whether a file says already what it should, no matter whose it is: two must not write it in turns.

        One that names nobody is written once more where the memory tells that it is ours.
        """
        if not _is_ours(setting, found) or _without_claims(found) != _without_claims(text):
            return False
        return self._claim(setting, found) is not None or setting.key not in self.memory

    def _leave(self, setting: Setting, path: str, found: FileFact) -> Step:
        """Return the step that only forgets: another wrote the file since, who puts back what was there."""
        del self.memory[setting.key]
        return Step(
            kind=Kind.SETTING,
            title=f"setting {setting.variable}: leave to {self._claim(setting, found.text)}",
            requests=(self._remember(),),
            subject=setting.key,
            change=Change(path=path, before=found.text, after=found.text),
        )

    def _former_values(self, setting: Setting, former: Mapping[str, str]) -> list[list[str]]:
        """Return the values to put back; one that has come since, or has another name now, is like its kin."""
        live = setting.live(self.facts, self.desired.paths)
        any_ = next(iter(former.values()), None)
        wishes = {path: former.get(path, any_) for path in live}
        return [
            [path, wish] for path, wish in wishes.items() if wish is not None and live[path] != wish
        ]

    def _remember(self) -> StepRequest:
        document = {"schema": MEMORY_SCHEMA, "settings": self.memory}
        body = (json.dumps(document, indent=1, sort_keys=True) + "\n").encode()
        return StepRequest(
            verb="write_file",
            arguments={"path": self.desired.memory_path, "mode": 0o644},
            body=body,
        )


def _head(setting: Setting) -> str:
    return HEADER.format(variable=setting.variable)


def _is_ours(setting: Setting, text: str | None) -> bool:
    return text is not None and text.startswith(_head(setting))


def _claims(text: str | None) -> list[str]:
    lines = (text or "").splitlines()
    said = (line[len(CLAIM) :].strip() for line in lines if line.startswith(CLAIM))
    return [claim for claim in said if claim]


def _without_claims(text: str | None) -> list[str]:
    return [line for line in (text or "").splitlines() if not line.startswith(CLAIM)]


def _write(path: str, text: str) -> StepRequest:
    body = text.encode(errors="surrogateescape")
    arguments = {"path": path, "mode": 0o644}
    return StepRequest(verb="write_file", arguments=arguments, body=body, as_root=True)


def _set(values: list[list[str]]) -> StepRequest:
    return StepRequest(verb="set_values", arguments={"values": values}, as_root=True)


def _shown(setting: Setting, values: Iterable[str]) -> str:
    return ", ".join(sorted({setting.show(value) for value in values}))


def _value_words(value: Any) -> str:
    return {True: "on", False: "off"}[value] if isinstance(value, bool) else str(value)
