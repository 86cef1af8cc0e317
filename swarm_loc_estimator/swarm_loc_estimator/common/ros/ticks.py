"""Call back once per period of a node's clock; periods that were missed are skipped, never queued."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.clock import Clock, JumpThreshold
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node

_EACH_CHANGE = JumpThreshold(
    min_forward=Duration(nanoseconds=1), min_backward=Duration(nanoseconds=-1), on_clock_change=False
)


class Ticks:
    """Ticks of a node, at the multiples of the period in simulated time.

    rclpy's timers do not bear simulated time on a busy machine: for each /clock that finds a timer due, the
    EventsExecutor enters the timer into a queue without bound, each entry moves the timer on by a period, and
    each reset that brings it back enters two more.

    Args:
        node: Whose clock it is; its executor calls back.
        period_s: [s].
        on_tick: Is called.
    """

    def __init__(self, node: Node, period_s: float, on_tick: Callable[[], None]) -> None:
        self._node = node
        self._on_tick = on_tick
        self._period_ns = round(period_s * 1e9)
        self._ticked = 0
        self._is_due = False
        if node.get_clock().ros_time_is_active:
            self._jumps = node.get_clock().create_jump_callback(_EACH_CHANGE, post_callback=self._on_time)
        else:  # a timer of a clock that nobody sets
            node.create_timer(period_s, on_tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    @property
    def _number(self) -> int:
        """Of the present period."""
        return int(self._node.get_clock().now().nanoseconds) // self._period_ns

    def _on_time(self, _jump: object) -> None:
        """Let the executor tick soon, once; this itself runs within the setting of the clock."""
        if self._number != self._ticked and not self._is_due and self._node.executor is not None:
            self._is_due = True
            self._node.executor.create_task(self._tick)

    def _tick(self) -> None:
        self._is_due = False
        if self._number == self._ticked:
            return
        self._on_tick()
        self._ticked = self._number  # which may have got to know a newer time meanwhile
