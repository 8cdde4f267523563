"""Files in the folder of a command hide no module from the processes that it starts."""

import pytest
from harness.cosmos_command import LOOSE, CosmosCommand

pytestmark = pytest.mark.process

HIDING = ("json", "queue", "numpy", "orjson", "msgpack")


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_a_file_called_like_a_module_that_a_run_needs_is_not_imported(tmp_path, mode):
    for name in HIDING:
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('hidden')\n")
    (tmp_path / "s.yaml").write_text(
        "name: s\nsimulation: counter\nagents: {count: 2, tick_hz: 10}\n"
        f"time: {{mode: {mode}, duration_s: 1}}\n"
    )
    cosmos = CosmosCommand(tmp_path)

    _, document = cosmos.run(tmp_path / "s.yaml", *LOOSE)

    assert document.get("status") == "complete", document
