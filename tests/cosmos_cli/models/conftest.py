"""What Ansible makes of inventories, for all tests here that ask it."""

import ansible_reading
import pytest


@pytest.fixture(scope="session")
def ansible(tmp_path_factory):
    with ansible_reading.AnsibleCommands(tmp_path_factory.mktemp("ansible")) as commands:
        yield commands
