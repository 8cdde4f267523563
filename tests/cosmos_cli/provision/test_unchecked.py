"""A machine whose check did not pass is checked again by the next `up`, although nothing is left to be done."""

import hashlib
import sys
from pathlib import Path

import pytest
from fake_system import CutConnection, FakeKit, connection_to, up
from provision_machines import machine_of

import madns_runtime
from cosmos_cli.fleet.failure import FailureKind
from cosmos_cli.provision.trees import TreeFile, tree_of

pytestmark = pytest.mark.process

DEADLINE_S = 60.0
LIBRARY = "library_of_the_system"


def tree_named(name):
    data = f"name = {name!r}\n".encode()
    digest = hashlib.sha256(data).hexdigest()
    file = TreeFile(path="code.py", sha256=digest, mode=0o444, size_bytes=len(data), source=data)
    return tree_of(name, [file])


class CheckedKit(FakeKit):
    """Where a check is more than a look, a module has to be there that no plan installs, as one of the system's would."""

    def __init__(self, folder, trees):
        super().__init__(trees=trees)
        self.folder = folder
        self.depths = []

    def checks(self, desired, udp, *, depth):
        self.depths.append(depth)
        if depth == "look":
            return []
        code = Path(madns_runtime.__file__).parents[1]
        arguments = {
            "python": sys.executable,
            "path": [str(code), str(self.folder)],
            "depth": "start",
            "modules": [LIBRARY],
            "timeout_s": DEADLINE_S,
        }
        return [{"verb": "check_runtime", "arguments": arguments}]


@pytest.fixture
def bring(tmp_path):
    """Return a function that makes the machine ready for trees; it tells the failure, and how deep it was checked."""

    def bring_up(*names, connection=None, **options):
        kit = CheckedKit(tmp_path, [tree_named(name) for name in names])
        machine = machine_of(variables={"cosmos_root": f"{tmp_path}/cosmos"})
        brought = up(connection or connection_to(tmp_path / "cosmos"), machine, kit, **options)
        return brought.failure and brought.failure.kind, kit.depths

    return bring_up


def test_machine_whose_check_failed_is_not_ready_until_it_passes(bring, tmp_path):
    first = bring("rover")
    second = bring("rover")
    looked_at = bring("rover", is_check=True)
    (tmp_path / f"{LIBRARY}.py").touch()
    mended = bring("rover")
    after = bring("rover")

    assert first == (FailureKind.STEP, ["look", "full"])
    assert second == (FailureKind.STEP, ["look", "full"])
    assert looked_at == (FailureKind.STEP, ["look", "full"])
    assert mended == (None, ["look", "full"])
    assert after == (None, ["look"])
    assert not (tmp_path / "cosmos/state/unchecked").exists()


def test_check_of_other_content_that_passes_does_not_stand_for_one_that_failed(bring, tmp_path):
    bring("rover")
    (tmp_path / f"{LIBRARY}.py").touch()
    bring("glider")
    (tmp_path / f"{LIBRARY}.py").unlink()

    assert bring("glider") == (None, ["look"])
    assert bring("rover") == (FailureKind.STEP, ["look", "full"])


@pytest.mark.parametrize("requests", range(5, 16))
def test_machine_that_was_cut_off_is_checked_by_the_next_up(bring, tmp_path, requests):
    (tmp_path / f"{LIBRARY}.py").touch()
    cut = CutConnection(connection_to(tmp_path / "cosmos"), requests)

    failure, _ = bring("rover", connection=cut)
    _, depths = bring("rover")

    assert cut.is_cut is (failure is FailureKind.LOST)
    assert depths == (["look", "full"] if cut.is_cut else ["look"])
