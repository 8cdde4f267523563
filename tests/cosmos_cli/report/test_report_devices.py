"""Figures of devices: their delay to the host's record, and their temperature beside the board's."""

import numpy as np
from harness.synthetic_run import MACHINE, T0_UTC, SyntheticRun

from cosmos_cli.collect.finish import finish_run
from cosmos_cli.report.build import build_sections
from madns_runtime.analysis.values import Figure, ReportRemark, TableBlock
from madns_runtime.hardware.contract import Channel
from madns_runtime.hardware.stream_schemas import schema_of
from madns_runtime.recording.records import StreamSchema
from madns_runtime.simulations.counter.parameters import DEVICE_SAMPLES

TEMPERATURE = schema_of(Channel(name="temperature", unit="degC"))


def sections_of(made, **changes):
    summary = finish_run(made.run, made.result(**changes), made.expected)
    document = {**summary.document, "devices": {f"{MACHINE}/hat": {"status": "ok"}}}
    return {section.title: section.blocks for section in build_sections(made.run, document)}


def measured(made, degrees, source=f"{MACHINE}/hat", zero_utc=T0_UTC):
    recorder = made.recorder(f"devices/{source}", source, TEMPERATURE)
    recorder.set_t0(zero_utc)
    for number, value in enumerate(degrees):
        recorder.record("temperature", (float(number), number + 1, 5000, value))
    recorder.close()


def figure_of(blocks, title):
    return next(b for b in blocks if isinstance(b, Figure) and b.title.startswith(title))


def test_a_devices_temperature_stands_beside_that_of_its_board(tmp_path):
    made = SyntheticRun(tmp_path).write(health_count=0)
    made.write_health(4, temperature_c=48.5)
    measured(made, [36.0, 36.5, 37.0])

    blocks = sections_of(made)["Devices"]

    board, device = figure_of(blocks, "Temperature of devices").choices[0].marks
    assert [board.name, device.name] == [f"{MACHINE}: board", f"{MACHINE}/hat temperature"]
    np.testing.assert_allclose(device.y, [36.0, 36.5, 37.0])
    np.testing.assert_allclose(board.x, [1.0, 2.0, 3.0, 4.0])  # since T0, as the device's
    table = next(b for b in blocks if isinstance(b, TableBlock) and b.title.startswith("Mean"))
    assert table.rows == [[f"{MACHINE}/hat temperature", MACHINE, 36.5, 48.5, -12.0]]


def test_a_boards_temperature_is_drawn_at_its_simulated_times_whatever_its_clock_shows(tmp_path):
    made = SyntheticRun(tmp_path).write(health_count=0)
    made.write_health(4, temperature_c=48.5)  # from 07:08:10 on, by the board's clock
    measured(made, [36.0, 36.5, 37.0], zero_utc="2024-05-06T06:08:05.000Z")

    board, _ = figure_of(sections_of(made)["Devices"], "Temperature of devices").choices[0].marks

    np.testing.assert_allclose(board.x, [3605.0, 3606.0, 3607.0, 3608.0])


def test_nothing_is_drawn_where_the_board_has_no_sensor_or_is_none(tmp_path):
    made = SyntheticRun(tmp_path).write()
    measured(made, [36.0])
    measured(made, [20.0], source="agent-01/hat")

    assert not [b for b in sections_of(made)["Devices"] if isinstance(b, Figure)]


def test_the_delay_from_reading_to_record_is_drawn_by_device_and_channel(tmp_path):
    made = SyntheticRun(tmp_path).write()
    recorder = made.recorder("host", "host", StreamSchema("device_samples", DEVICE_SAMPLES))
    for number in range(3):
        row = (float(number), "agent-01/hat", "gyro", number + 1, 2000 + 1000 * number, [0.0])
        recorder.record("device_samples", row)
        recorder.record("device_samples", (float(number), "agent-01/hat", "t", 1, 9000, 30.0))
    recorder.close()

    blocks = sections_of(made)["Device samples"]

    gyro, other = figure_of(blocks, "Delay from a device").choices[0].marks
    assert [gyro.name, other.name] == ["agent-01/hat gyro", "agent-01/hat t"]
    np.testing.assert_allclose(gyro.y, [2.0, 3.0, 4.0])
    [table] = [b for b in blocks if isinstance(b, TableBlock)]
    assert table.rows[0][:3] == ["agent-01/hat gyro", 3, 3.0]
    assert not [b for b in blocks if isinstance(b, ReportRemark)]
