"""A constellation's chapters of a report: which of its streams gets which figures."""

from __future__ import annotations

from dataclasses import replace

from madns_runtime.analysis.chapters import Chapter, build_sections
from madns_runtime.analysis.tables import ComparedRun, RecordedRun, RecordedTable
from madns_runtime.analysis.values import Block, Section, SimulationDifference
from madns_runtime.simulations.constellation.analysis.comparison import compare_runs
from madns_runtime.simulations.constellation.analysis.comparison_figures import comparison_figures
from madns_runtime.simulations.constellation.analysis.comparison_tables import (
    comparison_blocks,
    to_document,
)
from madns_runtime.simulations.constellation.analysis.links import (
    contact_blocks,
    link_blocks,
    message_blocks,
    refusal_blocks,
)
from madns_runtime.simulations.constellation.analysis.loop_latency import loop_blocks
from madns_runtime.simulations.constellation.analysis.maneuvers import (
    command_blocks,
    estimate_blocks,
    maneuver_blocks,
    slot_blocks,
    truth_change_blocks,
)
from madns_runtime.simulations.constellation.analysis.measurement_errors import sensor_blocks
from madns_runtime.simulations.constellation.analysis.orbits import (
    elements_blocks,
    invariants_blocks,
    state_blocks,
    truth_blocks,
)
from madns_runtime.simulations.constellation.analysis.predictions import prediction_blocks
from madns_runtime.simulations.constellation.analysis.slots import read_control
from madns_runtime.simulations.constellation.streams import SENSOR_STREAMS


def _sensor(table: RecordedTable, run: RecordedRun) -> list[Block]:
    """Return a sensor's errors, and how its model had predicted them."""
    return [*sensor_blocks(table, run), *prediction_blocks(table, run)]


CONTROL = "Control"
CHAPTERS = {
    "state": Chapter("Orbits", state_blocks),
    "elements": Chapter("Orbits", elements_blocks),
    "estimates": Chapter(CONTROL, estimate_blocks),
    "host_maneuvers": Chapter(CONTROL, maneuver_blocks),
    "commands": Chapter(CONTROL, command_blocks),
    "command_results": Chapter(CONTROL, command_blocks),
    "flight_answers": Chapter(CONTROL, loop_blocks),
    "truth_changes": Chapter(CONTROL, truth_change_blocks),
    "host_links": Chapter("Links", link_blocks),
    "messages": Chapter("Links", message_blocks),
    "refusals": Chapter("Links", refusal_blocks),
    "host_contacts": Chapter("Links", contact_blocks),
    **{name: Chapter("Sensors", _sensor) for name in SENSOR_STREAMS},
    **{f"{name}_model": Chapter("Sensors", sensor_blocks) for name in SENSOR_STREAMS},
    # Drawn as the errors of what stands beside it.
    **{f"{name}_truth": Chapter("Sensors", lambda table, run: ()) for name in SENSOR_STREAMS},
    "host_truth": Chapter("Truth on record", truth_blocks),
    "host_invariants": Chapter("Health of the model", invariants_blocks),
}
"""By table name, in the order of the report."""


def figures(run: RecordedRun) -> list[Section]:
    """Return the chapters of a run; what became of its slots comes before what flight software believes."""
    sections = build_sections(CHAPTERS, run)
    rows = read_control(run.tables, run.config)
    if not rows:
        return sections
    control = next((s for s in sections if s.title == CONTROL), Section(title=CONTROL, blocks=()))
    with_slots = replace(control, blocks=(*slot_blocks(rows), *control.blocks))
    if control not in sections:
        return [*sections, with_slots]
    return [with_slots if section is control else section for section in sections]


def compare(a: ComparedRun, b: ComparedRun) -> SimulationDifference:
    """Return what differs between two runs."""
    found = compare_runs(a, b)
    blocks = [*comparison_blocks(found), *comparison_figures(found)]
    return SimulationDifference(document=to_document(found), blocks=blocks)
