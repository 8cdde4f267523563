"""The distribution that `cosmos init --template package` writes is built, installed, and passes its own test."""

import os
import shutil
import subprocess
import sys

import pytest

from cosmos_cli import app

pytestmark = [pytest.mark.process, pytest.mark.timeout(600)]


def run(*command, cwd, path):
    search = os.pathsep.join([str(path), os.environ.get("PYTHONPATH", "")])
    # Its runs lie beside it, as its README has them: nobody's own settings send them elsewhere.
    kept = {name: value for name, value in os.environ.items() if not name.startswith("COSMOS_")}
    done = subprocess.run(
        [sys.executable, *map(str, command)],
        cwd=cwd,
        env={**kept, "PYTHONPATH": search, "COSMOS_STATE_DIR": str(cwd / "state")},
        capture_output=True,
        text=True,
        timeout=500,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder with the distribution's sources, and one that it is installed into as a wheel."""
    folder = tmp_path_factory.mktemp("package")
    assert app.run(["init", "my-rovers", "--template", "package", "-d", str(folder), "-q"]) == 0
    wheels = folder / "wheels"
    source, target = folder / "my-rovers", folder / "site"
    run("-m", "build", "--wheel", "--outdir", wheels, source, cwd=folder, path=target)
    (wheel,) = wheels.glob("*.whl")
    install = ("-m", "pip", "install", "--no-deps", "--no-index", "--quiet", "--target", target)
    run(*install, wheel, cwd=folder, path=target)
    shutil.rmtree(source / "my_rovers")  # what is tried is what the wheel holds
    return source, target


def test_its_test_runs_it_in_lockstep_and_finds_nothing_undeclared(installed):
    source, target = installed
    lockstep = ("--quiet", "--set", "time.mode=lockstep")  # as its README has it, before the test
    run("-m", "cosmos_cli.app", "run", "my-rovers.yaml", *lockstep, cwd=source, path=target)

    assert list(source.glob("runs/*/flown/tests/test_my_rovers.py"))
    told = run("-m", "pytest", "-q", "-p", "no:cacheprovider", cwd=source, path=target)

    assert "2 passed" in told


def test_test_of_the_package_fails_on_what_is_not_declared(installed):
    source, target = installed
    streams = target / "my_rovers" / "streams.py"
    text = streams.read_text()
    streams.write_text(
        text.replace('        DeclaredStream(role="agent", name="drive", fields=DRIVE),', "")
    )
    try:
        with pytest.raises(AssertionError, match="stream drive is not declared"):
            run("-m", "pytest", "-q", "-k", "declared", cwd=source, path=target)
    finally:
        streams.write_text(text)


@pytest.mark.nightly
def test_test_of_the_package_fails_where_no_run_comes_to_its_end(installed):
    source, target = installed
    host = target / "my_rovers" / "host.py"
    text = host.read_text()
    host.write_text(text.replace("def setup(self", "def set_up(self"))
    try:
        with pytest.raises(AssertionError, match="RoverHost"):
            run("-m", "pytest", "-q", "-k", "repeats", cwd=source, path=target)
    finally:
        host.write_text(text)


def test_plan_knows_its_demand(installed):
    source, target = installed

    told = run("-m", "cosmos_cli.app", "plan", "my-rovers.yaml", cwd=source, path=target)

    assert "3 agents keep real time" in told
