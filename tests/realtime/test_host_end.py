"""The end of a detached run's host, as a supervisor on the same computer sees it."""

from types import SimpleNamespace
from typing import Any

import pytest

from madns_runtime.realtime.host_end import HOST_ENDED, LOOK_S, watch_host_end


@pytest.mark.parametrize(("children", "wait_s"), [({}, None), ({7: "closes its records"}, 3.0)])
def test_a_supervisor_that_nobody_tells_sees_that_the_host_has_left_its_result(
    tmp_path, children, wait_s
) -> None:
    timers: list[tuple[float, Any]] = []
    ends: list[str] = []
    reactor: Any = SimpleNamespace(
        now_s=lambda: 10.0, call_at=lambda when_s, call: timers.append((when_s, call))
    )
    timeouts = SimpleNamespace(shutdown_s=3.0)
    launch: Any = SimpleNamespace(
        directory=str(tmp_path), config=SimpleNamespace(timeouts=timeouts)
    )

    watch_host_end(launch, reactor, children, ends.append)
    when_s, look = timers.pop()
    look()
    assert (when_s, ends) == (10.0 + LOOK_S, [])

    (tmp_path / "host").mkdir()
    (tmp_path / "host" / "result.json").write_text("{}")
    timers.pop()[1]()
    if wait_s is not None:
        assert not ends
        when_s, end = timers.pop()
        assert when_s == 10.0 + wait_s
        end()

    assert (ends, timers) == ([HOST_ENDED], [])
