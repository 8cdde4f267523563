import pytest


@pytest.fixture
def own_places(tmp_path, monkeypatch):
    """Keep the register of processes and all runs in folders of the test's own."""
    monkeypatch.setenv("COSMOS_STATE_DIR", str(tmp_path / "state"))
    monkeypatch.setenv("COSMOS_RUNS", str(tmp_path / "runs"))
