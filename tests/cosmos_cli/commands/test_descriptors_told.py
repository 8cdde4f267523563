"""A command that is out of file descriptors says so, with the limit; that is no defect."""

import errno
import os

import pytest

from cosmos_cli import app
from cosmos_cli.commands import ps
from cosmos_cli.errors import ExitCode


@pytest.mark.parametrize("number", [errno.EMFILE, errno.ENFILE])
def test_command_out_of_descriptors_names_the_limit(monkeypatch, capsys, number):
    def fail():
        raise OSError(number, os.strerror(number), "/state/processes")

    monkeypatch.setattr(ps, "living_runs", fail)

    assert app.run(["ps"]) == ExitCode.MACHINES
    told = capsys.readouterr().err
    assert os.strerror(number) in told
    assert "ulimit -n" in told
    assert "defect" not in told
