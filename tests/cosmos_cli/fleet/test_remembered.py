"""Targets of an inventory are remembered while nothing that they depend on changes, and not longer."""

import os
import time

import pytest

from cosmos_cli.errors import InputError
from cosmos_cli.fleet import fleet, target_cache
from cosmos_cli.fleet.fleet import fleet_of
from cosmos_cli.fleet.target import Target
from cosmos_cli.fleet.target_cache import key_of, recall, remember

INVENTORY = "all:\n  hosts:\n    pi1: {ansible_host: 10.0.0.1}\n    pi2:\n"


@pytest.fixture
def inventory(tmp_path):
    folder = tmp_path / "inventory"
    folder.mkdir()
    file = folder / "tower.yaml"
    file.write_text(INVENTORY)
    return file


@pytest.fixture
def reads(monkeypatch):
    """How often an inventory was read."""
    counted = []
    read = fleet.machines_of
    monkeypatch.setattr(
        fleet, "machines_of", lambda *arguments: (counted.append(1), read(*arguments))[1]
    )
    return counted


def addresses(inventory, limit=None):
    return [target.address for target in fleet_of(inventory, limit).targets]


def test_second_reading_of_an_unchanged_inventory_is_spared(inventory, reads):
    first, second = addresses(inventory), addresses(inventory)

    assert first == second == ["10.0.0.1", "pi2"]
    assert len(reads) == 1


def test_machines_are_read_when_somebody_asks_for_them(inventory, reads):
    addresses(inventory)
    machines = fleet_of(inventory)

    assert len(reads) == 1
    assert [machine.name for machine in machines.machines] == ["pi1", "pi2"]
    assert machines.machines is machines.machines
    assert len(reads) == 2


def test_every_change_is_seen(inventory, reads):
    assert addresses(inventory) == ["10.0.0.1", "pi2"]
    inventory.write_text(INVENTORY.replace("10.0.0.1", "10.0.0.9"))
    assert addresses(inventory) == ["10.0.0.9", "pi2"]
    variables = inventory.parent / "host_vars"
    variables.mkdir()
    (variables / "pi2.yaml").write_text("ansible_host: 10.0.0.2\n")
    assert addresses(inventory) == ["10.0.0.9", "10.0.0.2"]
    assert addresses(inventory, "pi2") == ["10.0.0.2"]
    assert len(reads) == 4


def test_every_file_of_a_folder_counts(inventory):
    before = key_of(inventory.parent, None)
    (inventory.parent / "more").mkdir()
    (inventory.parent / "more" / "x.yaml").write_text("all:\n")

    assert key_of(inventory.parent, None) != before


def test_faulty_inventory_is_told_each_time(inventory):
    inventory.write_text("all:\n  hostss: {}\n")

    for _ in range(2):
        with pytest.raises(InputError):
            fleet_of(inventory)


def test_missing_inventory_is_told(tmp_path):
    assert key_of(tmp_path / "none.yaml", None) is None
    with pytest.raises(InputError):
        fleet_of(tmp_path / "none.yaml")


def test_a_pipe_for_an_inventory_is_refused_and_nobody_waits_for_it(tmp_path):
    """Nobody writes to it: to open it as a file is opened would take for ever."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)

    assert key_of(pipe, None) is None
    with pytest.raises(InputError, match="expected a file, got a pipe"):
        fleet_of(pipe)


def test_a_file_of_terabytes_is_not_remembered(inventory, tmp_path):
    with inventory.open("ab") as file:
        file.truncate(2**40)

    assert key_of(inventory, None) is None


def test_nothing_is_remembered_of_an_inventory_that_changes_while_it_is_read(
    inventory, monkeypatch
):
    text = inventory.read_text()
    load = fleet.machines_of

    def edit_and_load(*arguments):
        inventory.write_text(text.replace("10.0.0.1", "10.0.0.9"))
        return load(*arguments)

    monkeypatch.setattr(fleet, "machines_of", edit_and_load)
    assert addresses(inventory) == ["10.0.0.9", "pi2"]
    monkeypatch.setattr(fleet, "machines_of", load)
    inventory.write_text(text)

    assert addresses(inventory) == ["10.0.0.1", "pi2"]


def test_folder_that_is_gone_is_no_failure(inventory, tmp_path, monkeypatch):
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()

    assert key_of(inventory, None) is None
    assert addresses(inventory) == ["10.0.0.1", "pi2"]


def test_where_one_stands_counts_since_key_files_may_be_relative(inventory, tmp_path, monkeypatch):
    before = key_of(inventory, None)
    monkeypatch.chdir(tmp_path)

    assert key_of(inventory, None) != before


def test_inventory_that_is_too_large_is_not_remembered(inventory, monkeypatch):
    monkeypatch.setattr(target_cache, "BYTES_MAX", 10)

    assert key_of(inventory, None) is None
    remember(None, [])
    assert recall(None) is None


@pytest.mark.parametrize("content", [b"", b"[1]", b'[{"name": "pi"}]', b"\xff"])
def test_broken_memory_is_none(content, tmp_path, monkeypatch):
    monkeypatch.setenv("COSMOS_CACHE", str(tmp_path))
    (tmp_path / "targets").mkdir()
    (tmp_path / "targets" / "key").write_bytes(content)

    assert recall("key") is None


def test_cache_that_cannot_be_written_is_no_failure(inventory, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("COSMOS_CACHE", str(tmp_path / "file"))

    assert addresses(inventory) == ["10.0.0.1", "pi2"]


def test_oldest_is_forgotten(tmp_path, monkeypatch):
    monkeypatch.setenv("COSMOS_CACHE", str(tmp_path))
    monkeypatch.setattr(target_cache, "KEPT_MAX", 2)
    now_ns = time.time_ns()
    for age, key in enumerate("abc"):
        remember(key, [Target(name="pi", address="x")])
        os.utime(tmp_path / "targets" / key, ns=(now_ns, now_ns + (age - 9) * 10**9))

    assert [key for key in "abc" if recall(key)] == ["b", "c"]
