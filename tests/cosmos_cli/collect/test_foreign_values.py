"""Values of a run's files that readers of JSON take and its writers refuse: each is told, and costs no verdict."""

import json
import subprocess
import sys

import pytest
from harness.synthetic_run import SyntheticRun

from cosmos_cli.collect.finish import collect_run, finish_run
from cosmos_cli.evidence.run_directory import write_json
from cosmos_cli.evidence.tables import open_tables
from cosmos_cli.launch.events import Finished, parse_event
from madns_runtime.errors import PluginError
from madns_runtime.plugin import validation
from madns_runtime.recording import result_file

pytestmark = pytest.mark.usefixtures("own_places")

HUGE = 2**64 - 1
SOUND = {"status": "ok", "samples": 1, "errors": 0, "stale_ratio": 0.0, "lost": 0, "restarts": 0}
POINTS = ("played", "skipped", "lost", "refused", "late", "underruns")


def nested(levels):
    """Return a list in a list, and so on, as text."""
    return "[" * levels + "]" * levels


def deep(levels):
    """Return a mapping in a mapping, and so on."""
    value = {}
    for _ in range(levels - 1):
        value = {"k": value}
    return value


@pytest.fixture
def made(tmp_path):
    """Return a run that has ended and was not collected yet, with the host's result as the host left it."""
    made = SyntheticRun(tmp_path / "runs").write()
    (made.run.path / "host/result.json").write_text(json.dumps(made.result()))
    return made


def collected(made):
    """Collect the run and return what its verdict tells, which scripts and the next collection can read."""
    summary = collect_run(made.run, processes=lambda: [])

    assert made.run.read_json(made.run.run_json) == summary.document
    assert made.run.read_json(made.run.manifest_json) is not None
    return summary


def told(summary):
    """Return all that a verdict tells, as text."""
    checks = [check for check in summary.document["checks"] if not check["passed"]]
    return json.dumps([summary.verdict.text, summary.missing, checks])


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("host/result.json", '{{"status": "complete", "x": {}}}'),
        ("run.json", '{{"schema": 1, "status": "running", "versions": {{"x": {}}}}}'),
        ("plan.json", '{{"config": {{}}, "x": {}}}'),
        ("manifest.json", '{{"schema": 1, "files": {{"x": {}}}}}'),
    ],
)
def test_a_document_that_is_nested_too_deep_is_named(made, name, text):
    (made.run.path / name).write_text(text.format(nested(300)))

    summary = collected(made)

    assert f"{name}: cannot be used: " in told(summary).replace(
        "run.json cannot", "run.json: cannot"
    )
    assert summary.exit_code != 0


def record_event(made, more):
    """Put an event with more than its stream's fields before the end of an agent's."""
    stream = made.stream("agent-01", "events")
    first, *rest = stream.read_bytes().splitlines(keepends=True)
    event = b'{"t_s":0.0,"utc":null,"event":"x","more":%s}\n' % more.encode()
    end = json.dumps({"end": {"records": 2, "dropped": 0, "not_finite": 0}}).encode()
    stream.write_bytes(b"".join((first, *rest[:-1], event, end, b"\n")))


def test_details_of_an_event_that_are_nested_deep_are_kept_as_they_are(made):
    record_event(made, nested(300))

    summary = collected(made)

    assert summary.exit_code == 0, told(summary)
    (details,) = (
        each
        for _, columns in open_tables(made.run.tables)["events"].each(["details"])
        for each in columns["details"]
        if each is not None and "more" in each
    )
    assert json.loads(details) == {"more": json.loads(nested(300))}


def test_details_of_an_event_that_are_nested_deeper_than_python_goes_are_counted(made):
    record_event(made, nested(1000))

    summary = collected(made)

    assert "tables/events.parquet: 1 values of details (json) are null" in told(summary)


def test_an_end_line_with_a_count_beyond_all_counts_is_damaged(made):
    stream = made.stream("agent-01", "ticks")
    lines = stream.read_bytes().splitlines(keepends=True)
    end = dict.fromkeys(("records", "dropped", "not_finite"), HUGE)
    stream.write_bytes(b"".join((*lines[:-1], json.dumps({"end": end}).encode(), b"\n")))

    summary = collected(made)

    assert "agent-01: ticks" in told(summary)
    assert summary.exit_code == 5


@pytest.mark.parametrize("wrong", [1e300, HUGE])
def test_counts_of_a_device_that_are_none_break_its_checks(made, wrong):
    report = {"frozen": {"gyro": wrong}, "stimulus": {"x": dict.fromkeys(POINTS, wrong)}}
    counts = ("samples", "errors", "lost", "restarts", "refused")
    account = SOUND | dict.fromkeys(counts, wrong) | {"report": report}
    plan = json.loads(made.run.plan_json.read_bytes())
    write_json(made.run.plan_json, plan | {"devices": {"loopback": ["loopback/imu"]}})
    for name in ("devices.json", "devices.2.json"):
        (made.run.path / "machines/loopback" / name).write_text(
            json.dumps({"loopback/imu": account})
        )

    summary = collected(made)

    broken = {c["name"]: c["worst"] for c in summary.document["checks"] if not c["passed"]}
    assert broken == dict.fromkeys(("hardware.lost", "hardware.frozen"), "loopback/imu")


@pytest.mark.parametrize("wrong", [1e300, HUGE])
def test_counts_of_a_result_that_are_none_cost_no_verdict(made, wrong):
    """Sums of them are what no writer takes."""
    result = made.result(network={"received": 1}, refused={"mac": 1, "replayed": 1})
    path = made.run.path / "host/result.json"
    path.write_text(json.dumps(with_numbers(result, wrong)))

    collected(made)


def with_numbers(value, number):
    """Return a document in which all numbers are this one."""
    if isinstance(value, dict):
        return {key: with_numbers(item, number) for key, item in value.items()}
    if isinstance(value, list):
        return [with_numbers(item, number) for item in value]
    return number if isinstance(value, int | float) and not isinstance(value, bool) else value


class Operator:
    """The line to an operator, of which what is told can be written down."""

    dropped_count = 0

    def __init__(self):
        self.told = []

    def emit(self, event):
        self.told.append(json.dumps(event))

    def flush(self, timeout_s):
        return timeout_s > 0

    def close(self):
        """Do nothing."""


def test_a_deeper_summary_is_refused_and_a_deeper_result_is_none():
    with pytest.raises(PluginError, match="lists and mappings in each other"):
        validation.summary(deep(validation.SUMMARY_LEVELS_MAX + 1))

    assert parse_event(
        b'{"event":"finished","result":{"x":%s}}' % nested(300).encode()
    ) == Finished(None)


def test_the_deepest_summary_that_a_host_may_return_is_handed_over_and_judged(made):
    summary = validation.summary(deep(validation.SUMMARY_LEVELS_MAX))
    result = made.result() | {"simulation": summary}
    operator = Operator()

    assert result_file.hand_over(result, made.run.path / "host", operator) == 0
    assert len(operator.told) == 1
    assert collected(made).exit_code == 0
    assert finish_run(made.run, result, made.expected).exit_code == 0


GATHERED = """
import resource, sys
from pathlib import Path
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.evidence.tabulate import gather

pages = int(Path("/proc/self/statm").read_text().split()[0])
bound = pages * resource.getpagesize() + (1 << 29)
resource.setrlimit(resource.RLIMIT_AS, (bound, bound))
gathered = gather(RunDirectory(Path(sys.argv[1])), None, lambda what, share: None)
print([scan.records for scan in gathered.scans], *gathered.faults)
"""


@pytest.mark.process
@pytest.mark.parametrize("kind", ["float", "int"])
def test_a_long_text_among_many_numbers_is_null_and_needs_no_memory(tmp_path, kind):
    """NumPy made as long a text of each number: 3.8 GiB of a file of 128 KB."""
    folder = tmp_path / "0001-x/agents/a"
    folder.mkdir(parents=True)
    fields = [{"name": "x", "unit": "m", "kind": kind}]
    header = {"schema": 1, "source": "a", "stream": "state", "shape": "array", "fields": fields}
    end = {"end": {"records": 17_001, "dropped": 0, "not_finite": 0}}
    text = json.dumps(["A" * 60_000])
    lines = [json.dumps(header), *["[1]"] * 14_000, text, *["[2]"] * 3_000, json.dumps(end), ""]
    (folder / "state.jsonl").write_text("\n".join(lines))

    argv = [sys.executable, "-c", GATHERED, str(tmp_path / "0001-x")]
    child = subprocess.run(argv, capture_output=True, text=True, check=False)

    assert child.stdout.startswith("[17001] tables/state.parquet: 1 values of x ("), child.stderr
