"""
The plan of what a group declares for itself in `cosmos_provision`, in the order of the inventory. Pure.

A step may build on an earlier one of the same plan: two lines of one file, a line in a file that a step
before makes. So what the plan will have done is kept in a sketch, beside what the facts say.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.layout import at_home
from cosmos_cli.models.inventory import Variables
from cosmos_cli.models.machine_facts import FileFact, MachineFacts, condition_key
from cosmos_cli.models.provision_steps import (
    FileContent,
    LineInFile,
    ProvisionStep,
    ShellCommand,
    SystemdService,
)
from cosmos_cli.onboard.files import MISSING_FILE_ADVICE, MODE_DEFAULT, edited
from cosmos_cli.provision.step import Change, Kind, Step, StepRequest

COMMAND_TIMEOUT_S = 1800.0
SERVICE_TIMEOUT_S = 120.0
SIGN_OF_LIFE_TIMEOUT_S = 20.0
"""A command there says once a second that it still runs."""
ANSWER_MARGIN_S = 180.0
"""The machine itself ends its work in time, looks whether it is done, and says so."""
PACKAGES_LIFE_TIMEOUT_S = 30.0
"""The package manager's helper says once a second that it still runs."""
PACKAGES_WHOLE_TIMEOUT_S = 2000.0
"""The machine itself gives up after 1800 s."""
PACKAGE_BYTES = 20_000_000
"""A guess for one package; what it really takes only apt knows, and it looks itself."""
UNIT_FOLDERS = (
    "/etc/systemd/system/",
    "/usr/local/lib/systemd/system/",
    "/usr/lib/systemd/system/",
)

ENABLED = frozenset({"enabled", "enabled-runtime", "static", "alias", "indirect", "generated"})
"""Answers of `is-enabled` for a unit that starts by itself, or that no `enable` would change."""
DISABLED = frozenset(
    {"disabled", "static", "alias", "indirect", "generated", "masked", "not-found", "unknown"}
)
NOT_THERE = frozenset({"not-found", "unknown"})
RUNNING = frozenset({"active", "reloading", "activating"})


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Content:
    """Desired content of a file."""

    data: bytes = dataclasses.field(repr=False)
    sha256: str

    @classmethod
    def of(cls, data: bytes) -> Content:
        """Return bytes with their hash."""
        return cls(data=data, sha256=hashlib.sha256(data).hexdigest())


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class DeclaredStep:
    """A step of `cosmos_provision`, with its file's content; paths have no ~ any more."""

    step: ProvisionStep
    path: str | None = None
    """Of the file, or of the one that the line is in."""
    condition: Mapping[str, Any] | None = None
    """Of a command: what the machine is asked to learn whether it is done."""
    content: Content | None = None


@dataclasses.dataclass(slots=True)
class Sketch:
    """The machine as it will be once the steps before are done."""

    files: dict[str, FileFact]
    packages: set[str]
    """Those that will have been installed."""
    may_bring_files: bool = False
    """Whether packages or commands of the plan may make files that are not there yet."""
    has_fresh_units: bool = False
    """Whether systemd will have read all its units again."""


def declared_step(
    step: ProvisionStep, variables: Variables, home: str, read_file: Callable[[Path], Content]
) -> DeclaredStep:
    """
    Return a step of a machine's inventory as its plan needs it.

    Args:
        step: As it was written.
        variables: Of the machine.
        home: Of who logs in there.
        read_file: Gives the content of a file here.
    """
    match step.action:
        case FileContent(dest=dest, src=src, content=content):
            data = read_file(Path(src)) if src is not None else Content.of((content or "").encode())
            return DeclaredStep(step=step, path=at_home(dest, home), content=data)
        case LineInFile(path=path):
            return DeclaredStep(step=step, path=at_home(path, home))
        case ShellCommand() as command:
            as_root = step.become and variables.may_become_root
            return DeclaredStep(
                step=step, condition=_condition(command, home=home, as_root=as_root)
            )
        case _:
            return DeclaredStep(step=step)


def _condition(command: ShellCommand, *, home: str, as_root: bool) -> dict[str, Any]:
    if command.creates is not None:
        return {"creates": at_home(command.creates, home)}
    return {"unless": command.unless, "root": as_root}


def declared_steps(
    facts: MachineFacts, declared: tuple[DeclaredStep, ...], packages: Collection[str]
) -> Iterator[Step]:
    """
    Yield the steps that are not done yet.

    Args:
        facts: Of the machine.
        declared: All of them, in their order.
        packages: What steps before these install.

    Raises:
        MachineFailure: One cannot be done, such as a line in a file that is not there.
    """
    is_any_new = any(facts.packages.get(name) is None for name in packages)
    sketch = Sketch(files=dict(facts.files), packages=set(packages), may_bring_files=is_any_new)
    for each in declared:
        for step in _PLANNERS[each.step.kind](each, facts, sketch):
            name = each.step.name
            yield dataclasses.replace(step, title=f"{step.title} ({name})") if name else step


def package_step(facts: MachineFacts, names: Sequence[str], planned: set[str]) -> Iterator[Step]:
    """Yield one step for all of *names* that are neither installed nor *planned*, which they then are."""
    missing = [
        name
        for name in dict.fromkeys(names)
        if facts.packages.get(name) is None and name not in planned
    ]
    if not missing:
        return
    planned.update(missing)
    word = "package" if len(missing) == 1 else "packages"
    yield Step(
        kind=Kind.PACKAGE,
        title=f"{word} {', '.join(missing)}: install",
        requests=(
            StepRequest(
                verb="packages",
                arguments={"action": "install", "names": missing},
                as_root=True,
                timeout_s=PACKAGES_LIFE_TIMEOUT_S,
                whole_s=PACKAGES_WHOLE_TIMEOUT_S,
                streams=True,
            ),
        ),
        size_bytes=PACKAGE_BYTES * len(missing),
    )


def _packages(declared: DeclaredStep, facts: MachineFacts, sketch: Sketch) -> Iterator[Step]:
    for step in package_step(facts, declared.step.packages or (), sketch.packages):
        sketch.may_bring_files = True
        yield step


def _file(declared: DeclaredStep, facts: MachineFacts, sketch: Sketch) -> Iterator[Step]:
    action, path, content = declared.step.action, str(declared.path), declared.content
    assert isinstance(action, FileContent) and content is not None
    before = _known_file(sketch, path)
    changes = _file_changes(before, action, content.sha256)
    if not changes:
        yield from _stale_unit(path, facts, sketch, declared)
        return
    after = FileFact(
        kind="file",
        mode=_mode(action) if action.mode else before.mode or MODE_DEFAULT,
        owner=action.owner or before.owner,
        group=action.group or before.group,
        size_bytes=len(content.data),
        sha256=content.sha256,
        text=content.data.decode(errors="surrogateescape"),
    )
    sketch.files[path] = after
    how = {"path": path, "mode": _mode(action), "owner": action.owner, "group": action.group}
    yield Step(
        kind=Kind.FILE,
        title=f"file {path}: {', '.join(changes)}",
        requests=(
            StepRequest(
                verb="write_file",
                arguments=how,
                body=content.data,
                as_root=declared.step.become,
            ),
            *(_reload(path, sketch, declared) if before.sha256 != content.sha256 else ()),
        ),
        change=Change(path=path, before=before.text, after=after.text),
        size_bytes=len(content.data),
    )


def unit_of(path: str | None) -> str | None:
    """Return the name of the systemd unit that a file is of, also one in its folder of additions; None if it is of none."""
    for folder in UNIT_FOLDERS:
        if path is not None and path.startswith(folder):
            name, _, more = path.removeprefix(folder).partition("/")
            return name if not more else name.removesuffix(".d") if name.endswith(".d") else None
    return None


def _reload(path: str, sketch: Sketch, declared: DeclaredStep) -> Iterator[StepRequest]:
    """Yield, for a file of a unit, the request that lets systemd read it: of the same step, so that a cut leaves both undone."""
    if path.startswith(UNIT_FOLDERS):
        sketch.has_fresh_units = True
        yield _service_request({"reload": True}, declared)


def _stale_unit(
    path: str, facts: MachineFacts, sketch: Sketch, declared: DeclaredStep
) -> Iterator[Step]:
    """Yield a step for a file of a unit that is as wanted, but was not read by systemd: an earlier `up` was cut."""
    if unit_of(path) in facts.stale_units and not sketch.has_fresh_units:
        requests = tuple(_reload(path, sketch, declared))
        yield Step(kind=Kind.SERVICE, title="systemd: read its units again", requests=requests)


def _file_changes(before: FileFact, action: FileContent, sha256: str) -> list[str]:
    if before.kind == "missing":
        return ["create"]
    if before.kind == "denied":
        return ["write"]  # root will see whether it has to
    changes = ["change"] if before.sha256 != sha256 else []
    mode = _mode(action)
    if mode is not None and mode != before.mode:
        changes.append(f"mode {before.mode or 0:04o} -> {mode:04o}")
    for what, wanted, found, number in (
        ("owner", action.owner, before.owner, before.owner_id),
        ("group", action.group, before.group, before.group_id),
    ):
        if wanted is not None and not _is_called(wanted, found, number):
            changes.append(f"{what} {found} -> {wanted}")
    return changes


def _is_called(wanted: str, name: str | None, number: int | None) -> bool:
    """Tell whether a user or group that the inventory names, or gives the number of, is the one that was found."""
    return wanted == name or (wanted.isdecimal() and int(wanted) == number)


def _mode(action: FileContent) -> int | None:
    return None if action.mode is None else int(action.mode, 8)


def _known_file(sketch: Sketch, path: str) -> FileFact:
    found = sketch.files.get(path, FileFact())
    if found.kind in ("directory", "other"):
        what = "folder" if found.kind == "directory" else "special file"
        text = f"{path}: expected a file, got a {what}"
        raise MachineFailure(FailureKind.STEP, text, "correct the path in cosmos_provision")
    return found


def _line(declared: DeclaredStep, facts: MachineFacts, sketch: Sketch) -> Iterator[Step]:
    action, path = declared.step.action, str(declared.path)
    assert isinstance(action, LineInFile)
    before = _known_file(sketch, path)
    is_present = action.state == "present"
    if before.kind == "missing" and not is_present:
        return
    if before.kind == "missing" and not (action.create or sketch.may_bring_files):
        text = f"line in {path}: there is no such file on this machine"
        raise MachineFailure(FailureKind.STEP, text, MISSING_FILE_ADVICE)
    if before.kind != "missing" and before.text is None:
        text = f"line in {path}: the file cannot be read, or it is too long to be edited"
        raise MachineFailure(FailureKind.STEP, text)
    content = before.text or ""
    after = edited(content, line=action.line, regexp=action.regexp, is_present=is_present)
    if after == content and before.kind != "missing":
        yield from _stale_unit(path, facts, sketch, declared)
        return
    sketch.files[path] = dataclasses.replace(before, kind="file", text=after, sha256="")
    arguments = {
        "path": path,
        "line": action.line,
        "regexp": action.regexp,
        "is_present": is_present,
        "create": action.create,
    }
    yield Step(
        kind=Kind.LINE,
        title=f"line in {path}: {_line_words(action, content)}",
        requests=(
            StepRequest(verb="edit_line", arguments=arguments, as_root=declared.step.become),
            *_reload(path, sketch, declared),
        ),
        change=Change(path=path, before=before.text, after=after),
        size_bytes=len(after),
    )


def _line_words(action: LineInFile, content: str) -> str:
    if action.state == "absent":
        return f"remove {action.line if action.line is not None else f'what {action.regexp} finds'}"
    appended = edited(content, line=action.line, regexp=None, is_present=True)
    replaced = edited(content, line=action.line, regexp=action.regexp, is_present=True)
    return f"{'add' if appended == replaced else 'change to'} {action.line}"


def _service(declared: DeclaredStep, facts: MachineFacts, sketch: Sketch) -> Iterator[Step]:
    action = declared.step.action
    assert isinstance(action, SystemdService)
    found = facts.services.get(action.name)
    enabled, active = (found.enabled, found.active) if found else ("unknown", "unknown")
    # A package, or a command, may bring the unit, and start it at once.
    may_be_new = sketch.may_bring_files and enabled in NOT_THERE
    wishes = {
        "enable": action.enabled is True and enabled not in ENABLED,
        "disable": action.enabled is False and (may_be_new or enabled not in DISABLED),
        "start": action.state == "started" and active not in RUNNING,
        "stop": action.state == "stopped" and (may_be_new or active in RUNNING),
    }
    do = [word for word, is_wanted in wishes.items() if is_wanted]
    if do:
        is_doubtful = may_be_new and not {"enable", "start"} & set(do)
        asked = {"name": action.name, "do": do, "reload": True, "may_be_new": is_doubtful}
        also = ", if it is there by then" if is_doubtful else ""
        title = f"service {action.name}: {', '.join(do)}{also}"
        requests = (_service_request(asked, declared),)
        yield Step(kind=Kind.SERVICE, title=title, requests=requests)


def _service_request(asked: Mapping[str, Any], declared: DeclaredStep) -> StepRequest:
    return StepRequest(
        verb="service",
        arguments={**asked, "timeout_s": SERVICE_TIMEOUT_S},
        as_root=declared.step.become,
        timeout_s=SIGN_OF_LIFE_TIMEOUT_S,
        whole_s=(len(asked.get("do") or ()) + 1) * SERVICE_TIMEOUT_S + ANSWER_MARGIN_S,
        streams=True,
    )


def _command(declared: DeclaredStep, facts: MachineFacts, sketch: Sketch) -> Iterator[Step]:
    action, as_root = declared.step.action, declared.step.become
    assert isinstance(action, ShellCommand)
    condition = declared.condition
    assert condition is not None
    if facts.conditions.get(condition_key(condition)):
        return
    sketch.may_bring_files = True
    asked = {**condition, "run": action.run, "timeout_s": COMMAND_TIMEOUT_S}
    first = action.run.strip().splitlines()[0]
    more = " ..." if "\n" in action.run.strip() else ""
    yield Step(
        kind=Kind.COMMAND,
        title=f"command {first}{more}",
        requests=(
            StepRequest(
                verb="command",
                arguments=asked,
                as_root=as_root,
                timeout_s=SIGN_OF_LIFE_TIMEOUT_S,
                whole_s=COMMAND_TIMEOUT_S + ANSWER_MARGIN_S,
                streams=True,
            ),
        ),
    )


_PLANNERS: Mapping[str, Callable[[DeclaredStep, MachineFacts, Sketch], Iterator[Step]]] = {
    "packages": _packages,
    "file": _file,
    "line": _line,
    "service": _service,
    "command": _command,
}
