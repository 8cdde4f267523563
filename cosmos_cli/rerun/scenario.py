"""The scenario of a rerun: that of the recorded run in lockstep, with a `playback` in the place of each device."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from cosmos_cli.errors import InputError
from cosmos_cli.models.device_kinds import DeviceQuestion, KindAnswer, ask_kinds
from cosmos_cli.models.loading import ScenarioFile, check_scenario
from cosmos_cli.models.scenario import Scenario
from cosmos_cli.models.separate_process import SeparateDefect, SeparateFailure, work_separately
from cosmos_cli.models.yaml_source import yaml_text
from cosmos_cli.rerun.carried_over import ATTEMPTS_MAX, CarriedOver, carried_over
from cosmos_cli.rerun.early_ends import early_ends
from cosmos_cli.rerun.recorded_run import FlownRun, UsedDevice
from cosmos_cli.ui.foreign_text import clean_line
from cosmos_cli.ui.plural import counted
from madns_runtime.conditions.condition import HOST
from madns_runtime.config import RunConfig, ScenarioDevice, to_mapping
from madns_runtime.errors import MadnsError, PluginError
from madns_runtime.hardware.contract import Channel
from madns_runtime.hardware.kinds.playback import kind as PLAYER
from madns_runtime.hardware.kinds.playback import streams_of
from madns_runtime.hardware.status import sample_rate_hz
from madns_runtime.hardware.stream_schemas import DEVICE_STATE
from madns_runtime.plugin.queries import ask_rerun
from madns_runtime.plugin.registry import is_file, is_shipped, parse_parameters, resolve
from madns_runtime.recording.reader import read_stream
from madns_runtime.recording.stream_file import files_of

PLAYBACK: Final = "playback"
TICKS: Final = ("ticks", "tick_hz", "phase_s")
"""Settings of a player that say in which tick each sample is there."""
RATE_HZ: Final = 10.0
"""Of a device of which nobody knows how often it was read: its age is judged by it."""
RATE_ROWS_MAX: Final = 1000


@dataclass(frozen=True, slots=True, kw_only=True)
class RerunScenario:
    """A scenario that is flown again, and what is not as it was."""

    scenario: ScenarioFile
    remarks: tuple[str, ...]
    unlike: tuple[str, ...]
    """Streams of the simulation that tell of computers and networks: they are not compared."""
    left_out: tuple[str, ...] = ()
    """Words of actions that are not carried over."""
    ends: Mapping[str, float] = field(default_factory=dict)
    """Agents that ended before others, as the run was cut off or they were killed, each with the time of its last tick, s."""
    is_exact: bool = False
    """Whether nothing on record, where times are rounded, is played back: it was in lockstep, without devices, and flies by itself."""


def make_rerun(recorded: FlownRun) -> RerunScenario:
    """
    Return the scenario of a rerun.

    Raises:
        InputError: It has faults.
    """
    config = recorded.config
    try:
        told = _ask_simulation(config, recorded.run.path)
    except (MadnsError, SeparateFailure, SeparateDefect) as error:
        raise InputError(
            f"{recorded.run.name} cannot be flown again: {error}{_cure(recorded)}"
        ) from error
    remarks = list(told["remarks"])
    remarks += [
        f"{name}: {counted(agent.missed, 'tick')} missed; lockstep misses none"
        for name, agent in recorded.agents.items()
        if agent.missed
    ]
    carried = carried_over(recorded)
    values = _values(recorded, told["parameters"], carried, remarks)
    scenario = _checked(recorded, values, carried)
    return RerunScenario(
        scenario=scenario,
        remarks=tuple(dict.fromkeys([*remarks, *carried.remarks])),
        left_out=tuple(carried.left_out),
        ends=_ends(recorded),
        unlike=() if config.time.is_lockstep else tuple(told["unlike"]),
        is_exact=config.time.is_lockstep and not recorded.devices and told["flies_as_it_was"],
    )


def _cure(recorded: FlownRun) -> str:
    """Return what to do where today's file of a simulation does not answer; nothing where another flies, or it is no file."""
    today = recorded.run.read_config()
    folder, simulation = recorded.config.base_directory, recorded.config.simulation
    if today is None or today.base_directory != folder or not is_file(simulation):
        return ""
    return f"; where {simulation} is gone, or was changed since, fly the run's own copy with --as-recorded"


def _ends(recorded: FlownRun) -> dict[str, float]:
    """Return who ended before others, or, all with the host, before the rerun does, each with the time of its last tick, s."""
    if recorded.cut_s is not None:
        ends = {name: agent.last_s for name, agent in recorded.agents.items()}
        return {**ends, HOST: min(ends.values())}
    return {
        name: last_s
        for name, last_s in early_ends(recorded.agents).items()
        if recorded.is_cut_off or name in recorded.killed
    }


def _checked(recorded: FlownRun, values: Mapping[str, Any], carried: CarriedOver) -> ScenarioFile:
    """
    Return the scenario without those entries and checks that lockstep, or today's simulation, refuses.

    Raises:
        InputError: It has other faults.
    """
    head = f"# {recorded.run.name}, flown again in lockstep with its devices played back.\n"
    path = recorded.folder / f"{recorded.run.name}-rerun.yaml"
    for _ in range(ATTEMPTS_MAX):
        whole = {**values, **carried.values()}
        text = yaml_text(whole)
        try:
            return check_scenario(head + text, path)
        except InputError as refused:
            if not carried.leave_out(refused):
                raise
    raise InputError(
        f"{recorded.run.name}: its checks and its timeline do not go together any more"
    )


def _ask_simulation(config: RunConfig, run: Path) -> Mapping[str, Any]:
    """
    Return the parameters of the rerun as plain values, whether they are those of the run, remarks, and streams that are not compared.

    Raises:
        MadnsError: The simulation cannot be asked.
        SeparateFailure, SeparateDefect: Code that is not shipped did not answer.
    """
    folder = Path(config.base_directory)

    def work(tell: Callable[[str], None]) -> Mapping[str, Any]:
        tell(f"importing {config.simulation}")
        simulation = resolve(config.simulation, folder)
        if simulation.rerun is None:
            own = to_mapping(config.parameters)
            return {"parameters": own, "remarks": [], "unlike": [], "flies_as_it_was": True}
        parameters = parse_parameters(simulation, config.parameters)
        tell(f"rerun() of {config.simulation}")
        found = ask_rerun(
            simulation.rerun,
            folder,
            parameters=parameters,
            agents=config.agents.resolved_names(),
            run=run,
        )
        return {
            "parameters": to_mapping(found.parameters),
            "remarks": list(found.remarks),
            "unlike": list(found.unlike),
            "flies_as_it_was": bool(found.parameters == parameters),
        }

    if is_shipped(config.simulation):
        return work(lambda stage: None)

    def guarded(tell: Callable[[str], None]) -> Mapping[str, Any]:
        try:
            return work(tell)
        except MadnsError as error:
            return {"fault": str(error)}

    answer = work_separately(guarded, limit_s=config.timeouts.loading_s)
    if "fault" in answer:
        raise PluginError(str(answer["fault"]))
    return answer


def _values(
    recorded: FlownRun, parameters: Mapping[str, Any], carried: CarriedOver, remarks: list[str]
) -> dict[str, Any]:
    """Return the scenario as plain values, without what is carried over."""
    config = recorded.config
    agents, loss = config.agents, config.on_agent_loss
    if not config.time.is_lockstep:  # there losses repeat, as all else does
        agents = dataclasses.replace(agents, restarts_max=0)
        loss = "continue" if carried.loses_agents else "abort"
    time = dataclasses.replace(config.time, mode="lockstep")
    if config.on_agent_loss != loss:
        remarks.append("on_agent_loss: abort, as its losses are not flown again")
    hardware = dataclasses.replace(config.hardware, use=(), devices=_devices(recorded, remarks))
    values = {
        **{key: getattr(config, key) for key in Scenario.model_fields if hasattr(config, key)},
        "timeline": [],
        "name": config.scenario,
        "agents": agents,
        "time": time,
        "hardware": hardware,
        "on_agent_loss": loss,
        "parameters": dict(parameters),
    }
    plain: dict[str, Any] = json.loads(json.dumps(to_mapping(values)))
    return plain


def _devices(recorded: FlownRun, remarks: list[str]) -> tuple[ScenarioDevice, ...]:
    """Return a player of each device, for each agent that used it."""
    given = recorded.config.hardware.devices
    answers = _kinds(recorded)
    found = []
    for used in recorded.devices:
        device = None if used.given is None else given[used.given]
        answer = None if used.given is None else answers[used.given]
        if answer is None or answer.faults:
            answer = None
            remarks.append(
                f"{used.full_name}: its channels' limits are not on record: outputs are put out as they are given"
            )
        anew = len(files_of(used.folder, DEVICE_STATE.name)) - 1
        if anew > 0:
            remarks.append(
                f"{used.full_name}: its process was started anew, {counted(anew, 'time')}: what an earlier one had not"
                " written when it ended is in no rerun"
            )
        found.append(_player(recorded, used, device, answer, remarks))
    return tuple(found)


def _kinds(recorded: FlownRun) -> list[KindAnswer]:
    """Return what the kinds of the scenario's own devices say."""
    asked = [
        DeviceQuestion(
            path=(), kind=each.kind, parameters=each.parameters, base_directory=recorded.folder
        )
        for each in recorded.config.hardware.devices
    ]
    return ask_kinds(asked, limit_s=recorded.config.timeouts.loading_s)


def _player(
    recorded: FlownRun,
    used: UsedDevice,
    device: ScenarioDevice | None,
    answer: KindAnswer | None,
    remarks: list[str],
) -> ScenarioDevice:
    agent = recorded.agents[used.agent]
    channels = answer.channels if answer else ()
    parameters: dict[str, Any] = {
        "directory": str(used.folder),
        "tick_hz": recorded.config.agents.tick_hz,
        "limits": {each.name: list(each.limits) for each in channels if each.limits is not None},
        "queues": [each.name for each in _queues(used, answer)],
    }
    newest = [each.name for each in channels if each.passing == "newest" and each.is_frame]
    if newest and recorded.config.time.is_lockstep:  # in real time no two are due at once
        parameters["newest"] = newest
    if agent.ticks is not None:
        parameters |= {"ticks": str(agent.ticks), "phase_s": agent.phase_s}
    elif device is not None and device.kind == PLAYBACK:
        parameters |= _ticks_played(recorded, used, device, remarks)
    asked_hz = (device.rate_hz if device else None) or (answer.rate_hz if answer else None)
    # Its kind says what its inputs promise, a player's no more than its rate: by that it is stale, and lost.
    rate_hz = sample_rate_hz(asked_hz or _recorded_rate(used.folder), channels)
    return ScenarioDevice(
        name=used.name,
        kind=PLAYBACK,
        agents=(used.agent,),
        rate_hz=min(rate_hz, PLAYER.rate_hz_max),
        parameters=parameters,
        frozen_s=device.frozen_s if device else {},
    )


def _queues(used: UsedDevice, answer: KindAnswer | None) -> list[Channel]:
    """Return what passes each number once; of a kind that cannot be asked any input may, and its newest can be read, too."""
    if answer is None:
        found = [each for each, _ in streams_of(used.folder) if each.direction == "in"]
    else:
        found = [each for each in answer.channels if each.passing == "queue"]
    return [each for each in found if not each.is_frame]


def _ticks_played(
    recorded: FlownRun, used: UsedDevice, device: ScenarioDevice, remarks: list[str]
) -> dict[str, Any]:
    """Return the ticks by which a rerun's player gave its samples, which have their times, not the rerun's ticks."""
    played = {name: device.parameters[name] for name in TICKS if name in device.parameters}
    if played.get("ticks") is None:
        return {}
    if os.path.isfile(Path(recorded.folder, str(played["ticks"]))):
        return played
    remarks.append(
        f"{used.full_name}: {clean_line(str(played['ticks']))} is not there any more: its samples come in the first tick"
        " at or after their times, which may be another one"
    )
    return {}


def _recorded_rate(folder: Path) -> float:
    """Return how often a device was read, by its records, Hz."""
    rates = [RATE_HZ]
    for path in sorted(folder.glob("*.jsonl")):
        stream = read_stream(path)
        if "age_us" not in stream.field_names:
            continue
        times = [row[0] for row, _ in zip(stream.records(), range(RATE_ROWS_MAX), strict=False)]
        if len(times) > 2 and times[-1] > times[0]:
            rates.append((len(times) - 1) / (times[-1] - times[0]))
    return max(rates[1:], default=RATE_HZ)
