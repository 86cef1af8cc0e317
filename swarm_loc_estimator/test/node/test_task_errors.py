"""An error in a task of the executor is told, and ends the node."""

import subprocess
import sys

import pytest

_FAILING = """
from rclpy.node import Node
from swarm_loc_estimator.common import node as running

class Failing(Node):
    def run(self, stop):
        self.create_timer(0.01, lambda: self.executor.create_task({task}))
        return running.spin(self, stop)

def fail():
    raise ValueError("this is why")

async def fail_later():
    raise ValueError("this is why")

raise SystemExit(running.run_node("failing", lambda: Failing("failing")))
"""


@pytest.mark.parametrize("task", ["fail", "fail_later"])
def test_an_error_in_a_task_is_told_and_ends_the_node(task: str) -> None:
    code = _FAILING.format(task=task)
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert "ValueError: this is why" in ended.stderr
