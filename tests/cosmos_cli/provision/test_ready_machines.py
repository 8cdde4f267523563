"""`cosmos up` on a machine on which nothing is to be done: ready, or told why no run would succeed there."""

import dataclasses

import pytest
from fake_system import connection_to, up
from provision_machines import machine_of

from cosmos_cli.fleet.failure import FailureKind
from cosmos_cli.provision import up as up_module

pytestmark = pytest.mark.process


@pytest.fixture
def again(tmp_path, monkeypatch):
    """Return a function that brings a machine that is ready up again, with its disk changed."""
    machine = machine_of(variables={"cosmos_root": f"{tmp_path}/cosmos"})
    connection = connection_to(tmp_path / "cosmos")
    assert up(connection, machine).failure is None

    def up_again(is_check=False, **disk):
        def gather(*arguments, **options):
            facts, others = gather_facts(*arguments, **options)
            return dataclasses.replace(facts, disk=dataclasses.replace(facts.disk, **disk)), others

        monkeypatch.setattr(up_module, "gather_facts", gather)
        return up(connection, machine, is_check=is_check)

    gather_facts = up_module.gather_facts
    return up_again


@pytest.mark.parametrize("is_check", [False, True])
def test_disk_that_has_turned_read_only_fails_though_nothing_is_to_be_done(again, is_check):
    found = again(is_read_only=True, is_check=is_check)

    assert found.failure.kind is FailureKind.READ_ONLY
    assert "restart it" in found.failure.advice


def test_full_disk_is_noted_though_nothing_is_to_be_done(again):
    found = again(free_bytes=3_000_000)

    assert (found.failure, found.changed_count) == (None, 0)
    assert [note for note in found.notes if "3.0 MB are free" in note]
