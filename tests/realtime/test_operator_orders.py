"""Orders of the operator in real time: carried out, or said to be none."""

import pytest

from madns_runtime.realtime.operator_orders import OperatorOrders


class Stage:
    """Session and journal in one, which only remember."""

    def __init__(self) -> None:
        self.done: list[tuple[object, ...]] = []
        self.orders = OperatorOrders(
            self,  # type: ignore[arg-type]
            self,  # type: ignore[arg-type]
            end=lambda *how: self.done.append(("end", *how)),
            refuse=lambda order: self.done.append(("refused", order)),
        )

    def event(self, name: str, **values: object) -> None:
        self.done.append(("event", name, values))

    def say(self, level: str, text: str) -> None:
        self.done.append((level, text))

    def agent_exited(self, agent: str, how: str, now_s: float, *, pid: int | None) -> None:
        self.done.append(("exited", agent, how, pid))


@pytest.mark.parametrize(
    ("order", "done"),
    [
        ({"command": "stop"}, [("end", "operator", "stopped by the operator", "interrupted")]),
        (
            {"command": "stop", "reason": "lost", "status": "failed", "who": "pi/imu"},
            [("end", "pi/imu", "lost", "failed")],
        ),
        (
            {"command": "device", "device": "pi/imu", "status": "lost", "why": "pulled"},
            [
                ("event", "device", {"device": "pi/imu", "status": "lost", "why": "pulled"}),
                ("error", "device pi/imu: lost pulled"),
            ],
        ),
        (
            {"command": "inject", "target": "pi/imu", "action": "freeze", "number": 3},
            [("event", "fault", {"target": "pi/imu", "action": "freeze"})],
        ),
        (
            {"command": "agent_exited", "agent": "agent-01", "how": "was killed", "pid": 7},
            [("exited", "agent-01", "was killed", 7)],
        ),
        ({"command": "dance"}, [("refused", {"command": "dance"})]),
        ({"command": "device"}, [("refused", {"command": "device"})]),
    ],
)
def test_each_order_is_carried_out_and_what_is_none_is_refused(order, done):
    stage = Stage()

    stage.orders.obey(order)

    assert stage.done == done
