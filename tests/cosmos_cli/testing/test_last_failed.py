"""Tests that failed last, as they are remembered."""

import pytest

from cosmos_cli.testing.last_failed import memory_file, read_failed, remember_failed


@pytest.mark.parametrize("text", ['[["a", Infinity]]', '[["a"]]', "{}", "[" * 10_000, "\x00", ""])
def test_a_memory_that_holds_something_else_knows_nothing(tmp_path, monkeypatch, text):
    monkeypatch.setenv("COSMOS_STATE_DIR", str(tmp_path / "state/processes"))
    memory_file().parent.mkdir(parents=True, exist_ok=True)
    memory_file().write_text(text)
    memory_file().chmod(0o600)

    assert read_failed() == ()
    remember_failed([])
    assert memory_file().read_text() == "[]"
