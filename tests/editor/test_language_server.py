"""What an editor offers for a scenario by its JSON Schema, asked of the language server that editors use."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.editor.language_server import LanguageServer

pytestmark = [pytest.mark.nightly, pytest.mark.process, pytest.mark.timeout(600)]
SERVER = "yaml-language-server@1.25.0"
SCHEMA = Path(__file__).parents[2] / "scenarios/scenario.schema.json"
HEAD = f"# yaml-language-server: $schema={SCHEMA}\n"
SCENARIO = f"""\
{HEAD}name: a
simulation: counter
vars: {{rate: 5}}
agents:
  count: 3
  tick_hz: ${{rate}}
  
parameters:
  
"""  # noqa: W293 - where keys are completed


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    npm = shutil.which("npm")
    if npm is None or shutil.which("node") is None:
        pytest.skip("npm is not installed (.ci/tools nightly installs it)")
    folder = tmp_path_factory.mktemp("editor")
    own = {**os.environ, "npm_config_cache": str(folder / "cache")}
    (folder / "package.json").write_text("{}")
    subprocess.run(
        [npm, "install", "--no-audit", "--no-fund", "--silent", SERVER],
        cwd=folder,
        env=own,
        check=True,
        timeout=400,
    )
    server = LanguageServer(["node_modules/.bin/yaml-language-server", "--stdio"], folder)
    server.folder = folder
    yield server
    server.close()


@pytest.fixture(scope="module")
def scenario(server):
    path = server.folder / "a.yaml"
    path.write_text(SCENARIO)
    server.open(path)
    return path


def labels(found):
    items = found["items"] if isinstance(found, dict) else found
    return {item["label"] for item in items}


def hover(server, path, line, column):
    return server.at("hover", path, line, column)["contents"]["value"].replace("\\", "")


def test_completion_offers_the_keys_of_a_section_that_are_not_there_yet(server, scenario):
    found = labels(server.at("completion", scenario, 8, 3))

    assert {"names", "phase", "per_process", "restarts_max"} <= found
    assert "count" not in found


def test_completion_offers_the_parameters_of_the_simulation_that_is_named(server, scenario):
    found = labels(server.at("completion", scenario, 10, 3))

    assert {"service", "payload_bytes", "answer_hz", "read_on_tick"} <= found
    assert "satellites" not in found


def test_hover_shows_what_the_code_says_of_a_field(server, scenario):
    assert "Number of agents." in hover(server, scenario, 6, 4)
    assert "what this file does not say comes from there" in hover(
        server, _open(server, "hover", "extends: a.yaml\n"), 2, 3
    )


def test_words_of_a_timeline_are_completed_explained_and_judged(server):
    lines = f"{SCENARIO.replace(HEAD, '').split('parameters')[0].rstrip()}\ntimeline:\n"
    good = lines + "  - {at_s: 1, action: kill, agents: [agent-01]}\n  - at_s: 2\n    action: \n"
    path = _open(server, "timeline", good)
    count = (HEAD + good).count("\n")
    slip = _open(
        server, "timeline_slip", lines + "  - {at_s: 1, action: fail_wheels, agents: ['*']}\n"
    )

    assert {"annotate", "hang", "partition"} <= labels(
        server.at("completion", path, count, len("    action: ") + 1)
    )
    assert "Simulated time, s: once." in hover(server, path, count - 1, 6)
    assert server.faults(slip) != []


def test_a_scenario_with_variables_has_no_faults_there_and_a_slip_has_one(server):
    good = _open(
        server, "good", SCENARIO.replace(HEAD, "").rstrip() + " {payload_bytes: '${rate}'}\n"
    )
    slip = _open(server, "slip", "extends: a.yaml\nagents: {tick: 5}\n")

    assert server.faults(good) == []
    assert any("tick" in told for told in server.faults(slip))


def _open(server, name, text):
    path = server.folder / f"{name}.yaml"
    path.write_text(HEAD + text)
    server.open(path)
    return path
