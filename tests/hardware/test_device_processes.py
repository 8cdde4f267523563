"""Real processes of real drivers: read, written, killed, hung, unplugged, made safe."""

from __future__ import annotations

import os
import signal
import time

import orjson
import pytest
from harness.waiting import is_alive, wait_until

from madns_runtime.config import DeviceLaunch
from madns_runtime.errors import PluginError
from madns_runtime.hardware import guardian, manager, messages, page
from madns_runtime.hardware.guardian import ATTEMPTS_MAX
from tests.hardware import bench as bench_module
from tests.hardware.bench import AGENT, DeviceBench, line_bench

pytestmark = pytest.mark.process


def records(folder, name: str, device: str = "pi22/line") -> list:
    lines = (folder / "devices" / device / f"{name}.jsonl").read_bytes().splitlines()
    return [
        orjson.loads(line) for line in lines[1:] if not line.startswith((b'{"end"', b'{"t0_utc"'))
    ]


def test_samples_reach_the_agent_and_the_records(tmp_path):
    with line_bench(tmp_path) as (bench, _):
        line = bench.hardware["line"]
        bench.start_time()
        read = []

        def is_fresh() -> bool:
            read[:] = [time.monotonic(), line["time"], time.monotonic()]
            return read[1].number >= 20 and read[1].status == "ok"

        bench.until(is_fresh)
        before_s, reading, after_s = read
        assert 0 <= reading.age_s < 5.0
        assert before_s - 1e-3 <= reading.value + reading.age_s <= after_s + 1e-3
        result = bench.close()["pi22/line"]

    assert bench.statuses("line") == ["ok"]
    assert result["samples"] >= 20
    assert result["restarts"] == result["errors"] == result["lost"] == 0
    numbers = [record[1] for record in records(tmp_path, "time")]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert [event["event"] for event in records(tmp_path, "events")][:1] == ["opened"]


def test_writes_are_held_to_limits_recorded_and_made_safe_at_the_end(tmp_path):
    with line_bench(tmp_path) as (bench, terminal):
        bench.start_time()
        bench.until(lambda: bench.hardware["line"].status == "ok")
        bench.hardware["line"].write("valve", 0.25)
        bench.until(lambda: "VALVE 0.25" in terminal.heard())
        bench.hardware["line"].write("valve", 7.0)
        bench.until(lambda: "VALVE 1" in terminal.heard())
        result = bench.close()["pi22/line"]
        heard = terminal.heard()

    assert heard == ["OPEN", "VALVE 0.25", "VALVE 1", "SAFE"]
    assert result["report"]["valve_limited"] == 1
    assert [record[2] for record in records(tmp_path, "valve")] == [0.25, 1.0]


def test_a_write_is_put_out_when_it_is_due_and_a_newer_one_takes_its_place(tmp_path):
    with line_bench(tmp_path) as (bench, terminal):
        line = bench.hardware["line"]
        zero_s = bench.start_time()
        bench.hardware.use_clock(lambda t_s: zero_s + t_s)
        bench.until(lambda: line.status == "ok")
        due_s = time.monotonic() - zero_s + 0.5
        line.write("valve", 0.1, due_s=due_s + 1000.0)
        line.write("valve", 0.2, due_s=due_s)
        bench.run(0.3)
        heard, now_s = terminal.heard(), time.monotonic() - zero_s
        assert now_s >= due_s or "VALVE 0.2" not in heard  # the loop may have slept past it
        bench.until(lambda: "VALVE 0.2" in terminal.heard())
        result = bench.close()["pi22/line"]

    assert result["report"]["writes_replaced"] == 1
    assert "VALVE 0.1" not in terminal.heard()
    t_s, lateness_us, value = records(tmp_path, "valve")[0]
    assert value == 0.2
    assert t_s == pytest.approx(due_s, abs=1e-5)
    assert lateness_us >= 0


def test_nothing_moves_where_it_may_not(tmp_path):
    refused = {"may_move": False, "why_not": "the scenario is not armed"}
    with line_bench(tmp_path, launch=refused) as (bench, terminal):
        bench.until(lambda: bench.hardware["line"].status == "ok")
        bench.hardware["line"].write("valve", 0.5)
        counts = bench.manager.page_of("pi22/line").counts
        bench.until(lambda: counts.read().get("refused") == 1)
        result = bench.close()["pi22/line"]
        assert terminal.heard() == ["OPEN"]

    assert result["report"]["refused"] == 1
    [why] = [event["why"] for event in records(tmp_path, "events") if event["event"] == "refused"]
    assert "the scenario is not armed" in why


def test_a_value_that_the_driver_does_not_take_is_refused_and_the_device_stays_open(tmp_path):
    with line_bench(tmp_path, takes_no=0.5) as (bench, terminal):
        line = bench.hardware["line"]
        bench.until(lambda: line.status == "ok")
        counts = bench.manager.page_of("pi22/line").counts
        line.write("valve", 0.5)
        bench.until(lambda: counts.read().get("refused") == 1)
        line.write("valve", 0.25)
        bench.until(lambda: "VALVE 0.25" in terminal.heard())
        result = bench.close()["pi22/line"]
        assert terminal.heard() == ["OPEN", "VALVE 0.25", "SAFE"]

    assert (result["errors"], result["report"]["refused"]) == (0, 1)
    assert "writes_lost" not in {name for name, n in result["report"].items() if n}
    [why] = [event["why"] for event in records(tmp_path, "events") if event["event"] == "refused"]
    assert why == "valve: expected none of 0.5"


@pytest.mark.parametrize(
    ("channel", "value", "text"),
    [
        ("valve", [1.0, 2.0], "expected a number"),
        ("valve", float("nan"), "expected numbers"),
        ("time", 1.0, "no output 'time'"),
        ("valv", 1.0, "no output 'valv'"),
    ],
)
def test_what_is_no_value_of_an_output_is_refused_where_it_is_written(
    tmp_path, channel, value, text
):
    with line_bench(tmp_path) as (bench, _), pytest.raises(PluginError, match=text):
        bench.hardware["line"].write(channel, value)


def test_a_killed_process_is_made_safe_by_the_guardian_and_replaced(tmp_path):
    with line_bench(tmp_path) as (bench, terminal):
        bench.start_time()
        line = bench.hardware["line"]
        bench.until(lambda: line.status == "ok")
        line.write("valve", 1.0)
        bench.until(lambda: "VALVE 1" in terminal.heard() and bench.statuses("line") == ["ok"])
        before = line["time"].number

        os.kill(bench.pid_of(), signal.SIGKILL)
        bench.until(lambda: "SAFE" in terminal.heard())
        bench.until(lambda: line["time"].number > before)
        bench.until(lambda: bench.statuses("line")[-1] == "ok")
        result = bench.close()["pi22/line"]

    assert bench.statuses("line") == ["ok", "lost", "ok"]
    assert result["restarts"] == 1
    assert result["lost"] == 1
    assert "SIGKILL" in result["why"]


def test_a_driver_that_hangs_for_good_is_given_up_by_name_and_made_safe(tmp_path):
    hang = tmp_path / "hang"
    with line_bench(tmp_path, launch={"hang_s": 1.0}, hang_file=str(hang)) as (bench, terminal):
        bench.start_time()
        line = bench.hardware["line"]
        bench.until(lambda: line.status == "ok")
        pid = bench.pid_of()

        hang.touch()
        bench.until(lambda: line.status == "lost")
        bench.until(lambda: bench.pid_of() not in (0, pid))
        hang.unlink()
        bench.until(lambda: line.status == "ok")
        result = bench.close()["pi22/line"]
        heard = terminal.heard()

    assert "did not return within 1 s" in result["why"]
    assert heard.count("SAFE") >= 2  # the guardian's, and the end's


def test_a_read_of_half_a_second_only_ages_the_sample(tmp_path):
    with line_bench(tmp_path, rate_hz=100.0, read_s=0.5) as (bench, _):
        bench.start_time()
        line = bench.hardware["line"]
        bench.until(lambda: line["time"].number >= 1)
        ages = []
        for _ in range(10):
            bench.run(0.1)
            ages.append(line["time"].age_s)
        result = bench.close()["pi22/line"]

    assert max(ages) >= 0.5
    assert result["restarts"] == 0
    assert result["report"]["reads_skipped"] >= 49


@pytest.mark.parametrize("method", ["open", "read", "health"])
def test_a_driver_that_raises_is_told_by_name_and_tried_again(tmp_path, method):
    with line_bench(tmp_path, raises=method) as (bench, _):
        bench.start_time()
        bench.until(lambda: errors(bench) >= 2)
        result = bench.close()["pi22/line"]

    whys = [event["why"] for event in records(tmp_path, "events") if event["event"] == "error"]
    assert len(whys) >= 2
    assert f"Line.{method} raised ValueError: {method} does not work (line.py:" in whys[0]
    assert result["errors"] >= 2
    assert result["restarts"] == 0  # its process lives


@pytest.mark.usefixtures("unhurried")
def test_what_close_raises_is_counted_and_told_but_not_over_the_fault_before_it(
    tmp_path, monkeypatch
):
    closing = 'raise OSError("it is not open")'
    assert 'self._raise("close")' in bench_module.DRIVER
    monkeypatch.setattr(
        bench_module, "DRIVER", bench_module.DRIVER.replace('self._raise("close")', closing)
    )
    told = []
    for raises in ("", "read"):
        (tmp_path / raises).mkdir(exist_ok=True)
        with line_bench(tmp_path / raises, raises=raises) as (bench, _):
            bench.until(lambda bench=bench: "ok" in bench.statuses("line") or errors(bench) >= 2)
            told.append(bench.close()["pi22/line"])

    assert told[0]["errors"] == 1
    assert told[0]["why"].startswith("Line.close raised OSError: it is not open (line.py:")
    assert told[1]["why"].startswith("Line.read raised ValueError: read does not work (line.py:")


@pytest.mark.usefixtures("unhurried")
@pytest.mark.parametrize(
    ("ending", "why"),
    [
        ("os.kill(os.getpid(), signal.SIGKILL)", "killed by SIGKILL"),
        ("os._exit(0)", "exit code 0"),
    ],
)
def test_a_process_that_its_driver_ends_at_the_close_is_told_so(tmp_path, monkeypatch, ending, why):
    monkeypatch.setattr(
        bench_module, "DRIVER", bench_module.DRIVER.replace('self._raise("close")', ending)
    )
    with line_bench(tmp_path) as (bench, _):
        bench.until(lambda: bench.hardware["line"].status == "ok")
        result = bench.close()["pi22/line"]

    assert (result["why"], result["report"]["unreported"]) == (why, 1)


def test_a_driver_that_fails_while_it_is_made_is_lost_as_one_that_does_not_open(tmp_path):
    made = "\n    def __init__(self, parameters):\n        raise OSError('no such bus')\n"
    (tmp_path / "made.py").write_text(bench_module.DRIVER + "\n\nclass Made(Line):" + made)
    launch = DeviceLaunch(
        name="made", place="pi22", kind="./made.py:Made", base_directory=str(tmp_path),
        rate_hz=50.0, parameters={"port": ""}, users=(AGENT,),
    )  # fmt: skip
    bench = DeviceBench(tmp_path / "run", (launch,), lost_s=None)
    bench.start_time()
    bench.until(lambda: "lost" in bench.statuses("made"))
    [driven] = bench.manager._devices.values()
    state = driven.seat.page.header[page.STATE]
    result = bench.close()["pi22/made"]

    told = "./made.py:Made.__init__ raised OSError: no such bus (made.py:"
    [lost] = [event for event in bench.events if event.get("status") == "lost"]
    assert lost["why"].startswith(told)
    assert result["why"].startswith(told)
    assert state == page.CLOSED


def test_a_device_that_takes_its_time_to_close_is_lost_for_what_its_driver_raised(tmp_path):
    gone = tmp_path / "gone"
    with line_bench(tmp_path, rate_hz=5.0, gone_file=str(gone), close_s=0.4) as (bench, _):
        bench.start_time()
        bench.until(lambda: bench.hardware["line"].status == "ok")
        gone.touch()
        bench.until(lambda: "lost" in bench.statuses("line"))

    [lost] = [event for event in bench.events if event.get("status") == "lost"]
    assert "the line is gone" in lost["why"]


def errors(bench) -> int:
    [driven] = bench.manager._devices.values()
    return int(driven.seat.page.header[page.ERRORS])


@pytest.fixture
def unhurried(monkeypatch):
    """Wait for devices' processes and the guardian until they are done, however busy the machine is."""
    monkeypatch.setattr(guardian, "GRACE_S", 60.0)
    monkeypatch.setattr(manager, "END_S", 60.0)


@pytest.mark.usefixtures("unhurried")
@pytest.mark.parametrize("ending", ["make_safe", "alarm"])
def test_a_driver_that_fails_while_it_makes_safe_leaves_it_to_the_guardian(tmp_path, ending):
    """By an exception, or by an alarm of its own that ends its process."""
    with line_bench(tmp_path, raises=ending) as (bench, terminal):
        bench.until(lambda: bench.hardware["line"].status == "ok")
        bench.hardware["line"].write("valve", 1.0)
        bench.until(lambda: "VALVE 1" in terminal.heard())
        result = bench.close()["pi22/line"]
        assert terminal.heard().count("SAFE") == 1 + ATTEMPTS_MAX
    assert result["unsafe"] == 1
    assert "could not be made safe" in result["why"]
    assert bench.events[-1]["text"].startswith("pi22/line: could not be made safe")

    whys = [event["why"] for event in records(tmp_path, "events") if event["event"] == "error"]
    assert any("Line.make_safe raised ValueError" in why for why in whys) == (ending == "make_safe")


def test_another_device_in_its_place_is_a_fault(tmp_path):
    with line_bench(tmp_path, launch={"serial": "line-2"}) as (bench, terminal):
        bench.until(lambda: bench.hardware["line"].status == "lost")
        bench.close()
        assert set(terminal.heard()) == {"OPEN"}  # nothing is written to it, not even what is safe

    [first, *_] = [
        event["why"] for event in records(tmp_path, "events") if event["event"] == "error"
    ]
    assert first == "expected the device 'line-2', found 'line-1'"


def test_inserted_faults_act_on_what_is_read_and_are_recorded(tmp_path):
    with line_bench(tmp_path) as (bench, _):
        bench.start_time()
        line = bench.hardware["line"]
        bench.until(lambda: line.status == "ok")
        assert bench.manager.insert_fault("pi22/line", "freeze", None) is None
        first = line["time"]

        def stands_still() -> bool:
            nonlocal first
            if line["time"].value != first.value:
                first = line["time"]
            return line["time"].number >= first.number + 5

        bench.until(stands_still)
        bench.manager.insert_fault("pi22/line", "clear", None)
        bench.until(lambda: line["time"].value != first.value)

        bench.manager.insert_fault("pi22/line", "disconnect", None)
        bench.until(lambda: line.status == "lost")
        bench.manager.insert_fault("pi22/line", "clear", None)
        bench.until(lambda: line.status == "ok")
        assert "no device 'pi22/imu' here" in bench.manager.insert_fault("pi22/imu", "freeze", None)
        bench.close()

    actions = [
        event["action"] for event in records(tmp_path, "events") if event["event"] == "fault"
    ]
    assert actions == ["freeze", "clear", "disconnect", "clear"]


def test_counts_survive_the_process_that_counted(tmp_path):
    """A frozen input, then a killed process, then one that is killed before it gives its report."""
    with line_bench(tmp_path, launch={"frozen_s": {"time": 0.2}}) as (bench, _):
        bench.start_time()
        line = bench.hardware["line"]
        bench.until(lambda: line["time"].number > 0)
        bench.hardware["line"].write("valve", 7.0)
        bench.manager.insert_fault("pi22/line", "freeze", None)
        counts = bench.manager.page_of("pi22/line").counts
        bench.until(lambda: counts.read().get("frozen:time") == 1)
        bench.manager.insert_fault("pi22/line", "clear", None)
        frozen = line["time"]
        bench.until(lambda: line["time"].value != frozen.value)
        os.kill(bench.pid_of(), signal.SIGKILL)
        bench.until(lambda: bench.statuses("line")[-2:] == ["lost", "ok"])
        os.kill(bench.pid_of(), signal.SIGSTOP)
        result = bench.close()["pi22/line"]

    report = result["report"]
    assert report["frozen"] == {"time": 1}
    assert report["valve_limited"] == 1
    assert report["samples"] == result["samples"] > 0
    assert report["unreported"] == 1  # its records have no end


def test_devices_of_one_process_are_all_reported_where_one_message_does_not_hold_it(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(messages, "BYTES_MAX", 1000)  # two reports
    devices = tuple(
        DeviceLaunch(
            name=f"clock{number}",
            place="pi22",
            kind="null",
            base_directory=str(tmp_path),
            rate_hz=10.0,
            users=(AGENT,),
        )
        for number in range(5)
    )
    bench = DeviceBench(tmp_path, devices)
    result = bench.close()

    assert len(result) == 5
    assert [each["report"].get("unreported") for each in result.values()] == [None] * 5


def stand_still(bench):
    """Hold the device and its manager's loop up for longer than a device may be silent."""
    os.kill(bench.pid_of(), signal.SIGSTOP)
    time.sleep(1.5)


def test_a_device_that_stood_still_with_its_manager_is_not_lost(tmp_path, monkeypatch):
    monkeypatch.setattr(manager, "STALL_GRACE_S", 60.0)
    with line_bench(tmp_path, lost_s=1.0) as (bench, _):
        bench.until(lambda: bench.statuses("line")[-1:] == ["ok"])
        told, number = bench.statuses("line"), bench.hardware["line"]["time"].number
        stand_still(bench)
        os.kill(bench.pid_of(), signal.SIGCONT)
        bench.until(lambda: bench.hardware["line"]["time"].number > number + 1)

        assert bench.statuses("line") == told


def test_a_device_that_still_says_nothing_after_the_grace_is_lost(tmp_path):
    with line_bench(tmp_path, lost_s=1.0) as (bench, _):
        bench.until(lambda: bench.statuses("line")[-1:] == ["ok"])
        stand_still(bench)
        bench.until(lambda: bench.statuses("line")[-1] == "lost")


def test_a_process_whose_words_were_heard_by_another_look_is_not_taken_for_gone(tmp_path):
    with line_bench(tmp_path) as (bench, _):
        bench.until(lambda: bench.statuses("line") == ["ok"])
        pid = bench.pid_of()
        # As where its words and others' come at once: a timer between the two has heard them all.
        bench.manager._hear(bench.manager._processes[0])
        number = bench.hardware["line"]["time"].number
        bench.until(lambda: bench.hardware["line"]["time"].number > number + 5)
        assert bench.pid_of() == pid
        result = bench.close()["pi22/line"]

    assert (result["restarts"], result["why"]) == (0, "")


def test_a_driver_whose_close_does_not_return_is_named_at_the_end_and_made_safe_once(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(guardian, "GRACE_S", 60.0)  # it makes safe itself, whenever it gets there
    monkeypatch.setattr(manager, "KILL_WAIT_S", 60.0)
    with line_bench(tmp_path, close_s=600.0) as (bench, terminal):
        guardian_pid = bench.manager._guardian_pid
        bench.until(lambda: bench.statuses("line") == ["ok"])
        bench.hardware["line"].write("valve", 0.5)
        bench.until(lambda: bench.manager.page_of("pi22/line").header[page.MOVED] == 1.0)
        result = bench.close()["pi22/line"]
        wait_until(lambda: not is_alive(guardian_pid), "the guardian has ended")
        heard = terminal.heard()

    told = [event["text"] for event in bench.events if event["event"] == "log"]
    assert result["why"] == "its driver did not return within 3 s of the run's end"
    assert f"pi22/line: {result['why']}" in told
    assert result["unsafe"] == 0
    assert heard == ["OPEN", "VALVE 0.5", "SAFE", "OPEN", "SAFE"]  # the guardian has tried once


@pytest.mark.parametrize(("action", "value"), [("drop", 1.0), ("delay", 600.0)])
def test_a_device_whose_samples_a_fault_keeps_back_is_not_opened_anew(tmp_path, action, value):
    with line_bench(tmp_path, launch={"hang_s": 3.0}, lost_s=None) as (bench, terminal):
        bench.start_time()
        bench.until(lambda: bench.statuses("line")[-1:] == ["ok"])
        bench.manager.insert_fault("pi22/line", action, value)
        states = tmp_path / "devices" / "pi22" / "line" / "device_state.jsonl"
        bench.until(lambda: bench.hardware["line"].status == "lost")
        # Silence is looked for when a state is recorded, once per second: by then it would have been found.
        count = states.read_bytes().count(b"\n")
        bench.until(lambda: states.read_bytes().count(b"\n") > count + 4)
        result = bench.close()["pi22/line"]
        heard = terminal.heard()

    assert (result["errors"], heard) == (0, ["OPEN", "SAFE"])
    name = {"drop": "dropped", "delay": "delayed_left"}[action]
    assert result["report"][name] > 0


def test_words_of_a_driver_that_are_no_text_are_told_and_cost_no_process(tmp_path, monkeypatch):
    raised = 'raise ValueError(f"{method} does not work")'
    odd = 'raise __import__("madns_runtime.errors").errors.MachineError("it said \\udc80\\x1b[2J")'
    assert raised in bench_module.DRIVER
    monkeypatch.setattr(bench_module, "DRIVER", bench_module.DRIVER.replace(raised, odd))
    with line_bench(tmp_path, raises="read") as (bench, _):
        bench.until(lambda: errors(bench) >= 3)
        result = bench.close()["pi22/line"]

    assert result["restarts"] == 0
    assert result["why"] == "it said \\udc80\x1b[2J"


def test_a_process_that_cannot_begin_is_lost_for_what_kept_it(tmp_path):
    (tmp_path / "devices").write_text("in the way")
    with line_bench(tmp_path) as (bench, _):
        bench.until(lambda: "lost" in bench.statuses("line"))
        lost = next(each for each in bench.events if each.get("status") == "lost")
        result = bench.close()["pi22/line"]

    assert "pi22/line: cannot record there" in lost["why"]
    assert "pi22/line: cannot record there" in result["why"]


def test_the_owners_end_makes_outputs_safe_while_the_device_goes_on(tmp_path):
    with line_bench(tmp_path) as (bench, terminal):
        bench.start_time()
        line = bench.hardware["line"]
        bench.until(lambda: line.status == "ok")
        owner = os.fork()
        if owner == 0:
            time.sleep(60)
            os._exit(0)
        bench.manager.agents_started(("agent-01",), owner)
        line.write("valve", 1.0)
        bench.until(lambda: "VALVE 1" in terminal.heard())

        os.kill(owner, signal.SIGKILL)
        os.waitpid(owner, 0)
        bench.manager.agents_ended(("agent-01",))
        bench.until(lambda: "SAFE" in terminal.heard())
        before = line["time"].number
        bench.until(lambda: line["time"].number > before + 5)
        assert bench.statuses("line") == ["ok"]


def test_what_the_owner_last_said_is_not_carried_out_after_its_end(tmp_path):
    with line_bench(tmp_path) as (bench, terminal):
        bench.until(lambda: bench.hardware["line"].status == "ok")
        bench.hardware["line"].write("valve", 1.0)
        bench.until(lambda: "VALVE 1" in terminal.heard())
        os.kill(bench.pid_of(), signal.SIGSTOP)
        bench.hardware["line"].write("valve", 0.5)  # it waits in the socket
        bench.manager.agents_ended(("agent-01",))
        os.kill(bench.pid_of(), signal.SIGCONT)
        bench.until(lambda: "SAFE" in terminal.heard())
        bench.run(0.3)
        result = bench.close()["pi22/line"]
        heard = terminal.heard()

    # Which of the two it hears first is the kernel's choice: nothing moves after it was made safe.
    assert [word for word in heard if word.startswith("VALVE")][:1] == ["VALVE 1"]
    assert heard[-1] == "SAFE"
    assert heard.index("SAFE") > max(
        place for place, word in enumerate(heard) if word.startswith("VALVE")
    )
    assert result["restarts"] == 0


def test_a_healthy_process_is_not_given_up_when_its_owner_ends(tmp_path, monkeypatch):
    """The device is made safe before the guardian looks, and again moved by the owner that was started anew."""
    # A busy machine lets a process wait for longer than its own.
    monkeypatch.setattr(guardian, "GRACE_S", 3.0)
    with line_bench(tmp_path) as (bench, terminal):
        line, header = bench.hardware["line"], bench.manager.page_of("pi22/line").header
        bench.until(lambda: line.status == "ok")
        for _ in range(3):
            count = terminal.heard().count("VALVE 1")
            line.write("valve", 1.0)
            bench.until(lambda count=count: terminal.heard().count("VALVE 1") > count)
            owner = os.fork()
            if owner == 0:
                os._exit(0)
            bench.manager.agents_ended(("agent-01",))
            bench.until(lambda: not header[page.MOVED])
            bench.manager.agents_started(("agent-01",), owner)  # which has ended already
            os.waitpid(owner, 0)
        bench.run(3.5)
        assert bench.close()["pi22/line"]["restarts"] == 0


def test_a_disconnected_device_stays_so_for_longer_than_a_hang_and_through_a_new_process(tmp_path):
    with line_bench(tmp_path, launch={"hang_s": 5.0}) as (bench, _):
        line = bench.hardware["line"]
        bench.until(lambda: line.status == "ok")
        bench.manager.insert_fault("pi22/line", "disconnect", None)
        bench.until(lambda: line.status == "lost")
        bench.run(5.5)
        pid = bench.pid_of()
        os.kill(pid, signal.SIGKILL)
        bench.until(lambda: bench.pid_of() not in (0, pid))
        bench.run(0.5)
        assert line.status == "lost"
        bench.manager.insert_fault("pi22/line", "clear", None)
        bench.until(lambda: line.status == "ok")
        result = bench.close()["pi22/line"]

    assert result["restarts"] == 1  # by the test's own kill


def test_a_disconnected_device_hands_on_no_sample_that_a_delay_holds(tmp_path):
    with line_bench(tmp_path) as (bench, _):
        line, insert = bench.hardware["line"], bench.manager.insert_fault
        bench.until(lambda: line.status == "ok")
        insert("pi22/line", "delay", 0.5)
        bench.run(0.6)
        insert("pi22/line", "disconnect", None)
        bench.until(lambda: line.status == "lost")
        number = line["time"].number
        bench.run(0.8)
        assert line["time"].number == number
        insert("pi22/line", "clear", None)
        bench.until(lambda: line["time"].number > number)
        insert("pi22/line", "delay", 60.0)
        samples = bench.manager.page_of("pi22/line").header
        before = samples[page.SAMPLES]
        bench.until(lambda: samples[page.SAMPLES] > before + 5)
        insert("pi22/line", "disconnect", None)
        bench.until(lambda: line.status == "lost")
        report = bench.close()["pi22/line"]["report"]

    assert report["delayed_left"] >= 5


def tape_launch(tmp_path, times_s, **settings) -> DeviceLaunch:
    """Write a recording of the values 0, 1, ... at some times, and return what plays it."""
    recorded = tmp_path / "recorded"
    recorded.mkdir()
    fields = ",".join(
        f'{{"name":"{name}","unit":"","kind":"float"}}' for name in ("t_s", "number", "age_us", "v")
    )
    (recorded / "v.jsonl").write_text(
        f'{{"schema":1,"stream":"v","shape":"array","fields":[{fields}]}}\n'
        + "".join(f"[{t_s},{number + 1},0,{number}]\n" for number, t_s in enumerate(times_s))
    )
    return DeviceLaunch(
        name="tape",
        place="pi22",
        kind="playback",
        base_directory=str(tmp_path),
        rate_hz=50.0,
        parameters={"directory": "recorded"},
        users=(AGENT,),
        **settings,
    )


def test_a_recording_that_is_opened_anew_goes_on_and_does_not_begin_anew(tmp_path):
    launch = tape_launch(tmp_path, [number / 50 for number in range(50 * 60)])
    bench = DeviceBench(tmp_path, (launch,))
    try:
        bench.start_time()
        tape = bench.hardware["tape"]
        bench.until(lambda: tape["v"].number >= 20)
        bench.manager.insert_fault("pi22/tape", "disconnect", None)
        bench.until(lambda: tape.status == "lost")
        bench.run(0.3)
        before = tape["v"].number
        bench.manager.insert_fault("pi22/tape", "clear", None)
        bench.until(lambda: tape["v"].number >= before + 20)
    finally:
        result = bench.close()["pi22/tape"]

    values = [record[3] for record in records(tmp_path, "v", "pi22/tape")]
    assert values == sorted(set(values))
    assert result["report"]["passed_while_closed"] >= before


def test_a_recording_begins_with_simulated_time_and_is_no_fault_where_it_has_a_gap(tmp_path):
    bench = DeviceBench(tmp_path, (tape_launch(tmp_path, [0.0, 0.1, 2.6], hang_s=0.2),))
    try:
        tape = bench.hardware["tape"]
        bench.run(1.5)
        assert (tape["v"].number, tape.status) == (0, "never"), "time is still to begin"
        bench.start_time()
        bench.until(lambda: tape["v"].number >= 3)
    finally:
        result = bench.close()["pi22/tape"]

    assert [record[3] for record in records(tmp_path, "v", "pi22/tape")] == [0, 1, 2]
    assert records(tmp_path, "v", "pi22/tape")[0][0] == 0.0, "its own time"
    assert result["errors"] == 0
    assert result["report"].get("passed_while_closed", 0) == 0
