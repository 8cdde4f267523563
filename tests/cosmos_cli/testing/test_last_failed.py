"""Tests that failed last, as they are remembered."""

import threading

import pytest
from suite_cases import make_case, make_result

from cosmos_cli.testing import last_failed
from cosmos_cli.testing.last_failed import memory_file, read_failed, remember_failed
from cosmos_cli.testing.outcome import judge_case


@pytest.mark.parametrize("text", ['[["a", Infinity]]', '[["a"]]', "{}", "[" * 10_000, "\x00", ""])
def test_a_memory_that_holds_something_else_knows_nothing(tmp_path, monkeypatch, text):
    monkeypatch.setenv("COSMOS_STATE_DIR", str(tmp_path / "state/processes"))
    memory_file().parent.mkdir(parents=True, exist_ok=True)
    memory_file().write_text(text)
    memory_file().chmod(0o600)

    assert read_failed() == ()
    remember_failed([])
    assert memory_file().read_text() == "[]"


def test_of_two_suites_that_end_at_once_both_are_remembered(tmp_path, monkeypatch):
    monkeypatch.setenv("COSMOS_STATE_DIR", str(tmp_path / "state/processes"))
    first, second = (
        [judge_case(make_case(name), make_result(4), is_interrupted=False)] for name in "ab"
    )
    other = threading.Thread(target=remember_failed, args=(second,))

    def read_while_the_other_ends():
        found = read_failed()
        monkeypatch.setattr(last_failed, "read_failed", read_failed)
        other.start()
        other.join(0.3)
        return found

    monkeypatch.setattr(last_failed, "read_failed", read_while_the_other_ends)
    remember_failed(first)
    other.join()

    assert {path.rpartition("/")[2] for path, _ in read_failed()} == {"a.yaml", "b.yaml"}
