"""The report in a real browser: every figure draws, nothing fails, nobody is asked for anything."""

import re
import shutil
import subprocess

import pytest
from synthetic_run import SyntheticRun, make_config

from cosmos_cli.collect import finish_run

CHROMIUM = (
    shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
)
TIMEOUT_S = 120
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
  data.inspected = "yes";
};
look();
</script>"""

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here"),
]


@pytest.fixture
def page(tmp_path):
    made = SyntheticRun(tmp_path / "runs", make_config(6, ticks=600)).write(with_states=True)
    finish_run(made.run, made.result(), made.expected)
    text = made.run.report_html.read_text()
    watched = tmp_path / "watched.html"
    watched.write_text(
        text.replace("<style>", WATCH + "<style>", 1).replace("</body>", INSPECT + "</body>", 1)
    )
    return watched


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


def test_screenshot_is_taken_of_a_page_with_content(page):
    picture = page.parent / "report.png"

    browse(page, f"--screenshot={picture}")

    assert picture.read_bytes().startswith(b"\x89PNG")
    # An empty page of this size compresses to less than 30 kB.
    assert picture.stat().st_size > 100_000
