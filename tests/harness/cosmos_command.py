"""The command line as its user has it: a process of its own, with its own folders of runs and of the register."""

import json
import os
import subprocess
import sys
from pathlib import Path

from harness.warm_commands import warm_commands

PATIENCE_S = 240.0
SCENARIOS = Path(__file__).parents[2] / "scenarios"
LOOSE = (
    "deadline.max_miss_ratio=1",
    "time.rtf_tolerance=100",
    "timeouts.host_start_s=300",
    "timeouts.agents_ready_s=300",
    "timeouts.silence_s=30",
    "timeouts.complete_s=60",
    "timeouts.shutdown_s=60",
)
"""Settings with which a busy machine breaks no budget of time and loses no agent that waits for a processor."""


class CosmosCommand:
    """
    `cosmos`, working in a folder.

    Args:
        folder: Where commands are run, where runs and the register are.
        environment: More variables.
    """

    def __init__(self, folder, **environment):
        self.folder = folder
        self.runs = folder / "runs"
        self.environment = {
            **os.environ,
            "COSMOS_STATE_DIR": str(folder / "state"),
            "COSMOS_RUNS": str(self.runs),
            "NO_COLOR": "1",
            **environment,
        }

    def start(self, *arguments, **more):
        """Start a command with pipes for what it says."""
        warm = warm_commands()
        if not more and warm.fits(self.environment):
            return warm.start(list(map(str, arguments)), self.folder, self.environment)
        return subprocess.Popen(
            [sys.executable, "-P", "-m", "cosmos_cli.start", *map(str, arguments)],
            **{
                "cwd": self.folder,
                "env": self.environment,
                "stdin": subprocess.DEVNULL,
                "stdout": subprocess.PIPE,
                "stderr": subprocess.PIPE,
                "text": True,
                **more,
            },
        )

    def __call__(self, *arguments, patience_s=PATIENCE_S, **more):
        """Run a command to its end, which must come in time."""
        with self.start(*arguments, **more) as process:
            try:
                out, err = process.communicate(timeout=patience_s)
            except BaseException:
                process.kill()
                raise
        return subprocess.CompletedProcess(process.args, process.returncode, out, err)

    def start_run(self, scenario, *settings, options=("--no-report",)):
        """Start a scenario, one of the project's by its name, with settings `key=value`."""
        chosen = [part for setting in settings for part in ("--set", setting)]
        path = SCENARIOS / scenario  # an absolute path stays what it is
        return self.start("run", path, *chosen, *options, "--json", "--quiet")

    def run(self, scenario, *settings, options=("--no-report",)):
        """Run a scenario; return its exit code, which its run.json tells as well, and run.json."""
        with self.start_run(scenario, *settings, options=options) as process:
            try:
                out, err = process.communicate(timeout=PATIENCE_S)
            except BaseException:
                process.kill()
                raise
        assert out, err
        document = json.loads(out)
        assert document["exit_code"] == process.returncode, err
        return process.returncode, document

    def directory(self, document):
        """Return where the evidence of a run lies."""
        return self.runs / document["run"]
