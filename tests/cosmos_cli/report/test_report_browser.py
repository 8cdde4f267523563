"""The report in a real browser: every figure draws, nothing fails, nobody is asked for anything."""

import json
import re
import shutil
import subprocess

import pytest
from harness.synthetic_run import T0_UTC, SyntheticRun, make_config

from cosmos_cli.collect.finish import finish_run
from cosmos_cli.report.html import render_sections, write_report
from madns_runtime.analysis.values import Figure, FigureChoice, Section, Series
from madns_runtime.recording.records import LOG, Field, StreamSchema

CHROMIUM = (
    shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
)
TIMEOUT_S = 240
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    # WebGL in software, as a machine without a graphics card has it.
    "--enable-unsafe-swiftshader",
    # Whatever the browser itself wants from the network, it does not find.
    "--host-resolver-rules=MAP * ~NOTFOUND",
    "--window-size=1200,5000",
    "--virtual-time-budget=60000",
)
WATCH = """<script>
const watched = document.documentElement.dataset;
watched.errors = ""; watched.violations = 0;
addEventListener("error", (event) => { watched.errors += event.message + ";"; });
addEventListener("unhandledrejection", (event) => { watched.errors += event.reason + ";"; });
addEventListener("securitypolicyviolation", (event) => { watched.violations++; });
const tell = console.error;
console.error = (...parts) => { watched.errors += parts.join(" ") + ";"; tell(...parts); };
</script>"""
INSPECT = """<script>
const look = () => {
  const data = document.documentElement.dataset;
  if (data.drawn !== data.figures) { setTimeout(look, 50); return; }
  const empty = [...document.querySelectorAll(".plot")].filter((plot) =>
    !plot.querySelector(".scatterlayer .trace path, .barlayer .point path, .gl-container canvas"));
  data.empty = empty.map((plot) => plot.id).join(" ");
  data.requests = performance.getEntriesByType("resource").filter((e) => !/^(data|blob):/.test(e.name)).length;
  data.scripts = document.scripts.length;
  data.shown = document.documentElement.innerHTML.split("{{plotly}}&lt;/script&gt;").length - 1;
  const behind = [...document.querySelectorAll("td.n + td:not(.n), th.n + th:not(.n)")];
  data.behind = behind.length;
  data.touching = behind.filter((cell) => parseFloat(getComputedStyle(cell).paddingLeft) < 5).length;
  data.inspected = "yes";
};
look();
</script>"""

HOSTILE = (
    "{{plotly}}</script><script>document.documentElement.dataset.owned=1</script>"
    '<!--<script>{{figures}}{{script}}{{css}}{{body}}<b onclick="a()">&lt;b%{y}\x1b[31m\u202e$ "\'\\'
)

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here"),
]


@pytest.fixture
def page(tmp_path):
    made = SyntheticRun(tmp_path / "runs", make_config(6, ticks=600)).write(with_states=True)
    finish_run(made.run, made.result(), made.expected)
    return watched(made.run.report_html, tmp_path)


@pytest.fixture
def hostile_page(tmp_path):
    """Return the report of a run that says markup, placeholders and ends of scripts wherever it may speak."""
    made = SyntheticRun(tmp_path / "runs", make_config(2, ticks=60)).write()
    recorder = made.recorder("agents/agent-01", "agent-01", LOG)
    write_stream(made, "agents/agent-01/mine.jsonl")
    recorder.record("log", {"t_s": 0.0, "utc": T0_UTC, "level": "error", "text": HOSTILE})
    made.records["agent-01"] = recorder.close().to_mapping()
    check = {"name": HOSTILE, "limit": 0, "got": 1, "passed": False}
    result = made.result(reason=HOSTILE, simulation={"checks": [check]})
    finish_run(made.run, result, made.expected)
    document = json.loads(made.run.run_json.read_text()) | {"remarks": [HOSTILE]}
    document |= {"verdict": HOSTILE, "scenario": HOSTILE, "versions": {HOSTILE: HOSTILE}}
    write_report(made.run, document)
    return watched(made.run.report_html, tmp_path)


def write_stream(made, name):
    """Write records whose field no recorder would take: a run may come from anywhere."""
    schema = StreamSchema("mine", (Field("tick", "", "int"), Field(HOSTILE, HOSTILE)))
    lines = [schema.header(run=made.run.name, source="agent-01", t0_utc=T0_UTC)]
    lines += [[tick, float(tick)] for tick in range(60)]
    lines += [{"end": {"records": 60, "dropped": 0, "not_finite": 0}}]
    path = made.run.path / name
    path.write_text("".join(f"{json.dumps(line)}\n" for line in lines))


def watched(report, folder):
    """Return a copy of a report that tells what goes wrong in it."""
    page = folder / "watched.html"
    head, tail = report.read_text().split("<style>", 1)
    body, end = tail.rsplit("</body>", 1)
    page.write_text(f"{head}{WATCH}<style>{body}{INSPECT}</body>{end}")
    return page


def browse(page, *more):
    profile = page.parent / "profile"
    command = [CHROMIUM, *FLAGS, f"--user-data-dir={profile}", *more, page.as_uri()]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=TIMEOUT_S, cwd=page.parent
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_figure_draws_without_an_error_or_a_request(page):
    dom = browse(page, "--dump-dom")

    root = re.search(r"<html[^>]*>", dom)[0]
    told = dict(re.findall(r'data-(\w+)="([^"]*)"', root))
    assert told["inspected"] == "yes", root
    assert int(told["figures"]) >= 10
    assert told["drawn"] == told["figures"]
    assert (told["failed"], told["errors"], told["empty"]) == ("0", "", "")
    assert (told["requests"], told["violations"]) == ("0", "0")
    assert int(told["behind"]) > 0
    assert told["touching"] == "0"  # words do not touch the number before them


def test_page_shows_what_a_run_said_and_does_nothing_of_it(hostile_page):
    dom = browse(hostile_page, "--dump-dom")

    root = re.search(r"<html[^>]*>", dom)[0]
    told = dict(re.findall(r'data-(\w+)="([^"]*)"', root))
    assert told["inspected"] == "yes", root
    assert told["drawn"] == told["figures"]
    assert int(told["figures"]) >= 5
    assert (told["failed"], told["errors"], told["empty"]) == ("0", "", "")
    assert (told["requests"], told["violations"]) == ("0", "0")
    assert told["scripts"] == "5"  # three of its own, and the two of this test
    assert "owned" not in told
    # In the verdict, the facts, a check, a remark, the log, a chapter's figure and its axis, versions.
    assert int(told["shown"]) >= 8


@pytest.mark.nightly
def test_a_comparisons_figures_draw_too(tmp_path):
    marks = [Series(x=[0.0, 1.0], y=[1.0, 2.0], name=HOSTILE)]
    figure = Figure(title=HOSTILE, choices=[FigureChoice(marks=marks)])
    told = {"is_same": False, "verdict": HOSTILE, "lines": [HOSTILE]}
    page = tmp_path / "comparison.html"
    sections = [Section(title=HOSTILE, blocks=[figure])]
    page.write_text(render_sections("comparison.html", sections, title=HOSTILE, comparisons=[told]))

    dom = browse(watched(page, tmp_path), "--dump-dom")

    root = re.search(r"<html[^>]*>", dom)[0]
    found = dict(re.findall(r'data-(\w+)="([^"]*)"', root))
    assert (found["figures"], found["drawn"], found["failed"], found["errors"]) == (
        "1",
        "1",
        "0",
        "",
    )
    assert (found["requests"], found["violations"], found["scripts"]) == ("0", "0", "5")
    assert "owned" not in found


@pytest.mark.nightly
def test_screenshot_is_taken_of_a_page_with_content(page):
    picture = page.parent / "report.png"

    browse(page, f"--screenshot={picture}")

    assert picture.read_bytes().startswith(b"\x89PNG")
    # An empty page of this size compresses to less than 30 kB.
    assert picture.stat().st_size > 100_000
