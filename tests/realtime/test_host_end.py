"""The end of a detached run's host, as a supervisor on the same computer sees it."""

from types import SimpleNamespace
from typing import Any

from madns_runtime.realtime.host_end import HOST_ENDED, LOOK_S, watch_host_end


def test_a_supervisor_that_nobody_tells_sees_that_the_host_has_left_its_result(tmp_path) -> None:
    timers: list[tuple[float, Any]] = []
    ends: list[str] = []
    reactor: Any = SimpleNamespace(
        now_s=lambda: 10.0, call_at=lambda when_s, call: timers.append((when_s, call))
    )
    launch: Any = SimpleNamespace(directory=str(tmp_path))

    watch_host_end(launch, reactor, ends.append)
    when_s, look = timers.pop()
    look()
    assert (when_s, ends) == (10.0 + LOOK_S, [])

    (tmp_path / "host").mkdir()
    (tmp_path / "host" / "result.json").write_text("{}")
    timers.pop()[1]()

    assert (ends, timers) == ([HOST_ENDED], [])
