"""What all tests share: the same examples in CI, and for each node test ROS in a domain that no other has."""

from __future__ import annotations

import faulthandler
import gc
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from importlib.util import find_spec
from multiprocessing import get_context
from typing import TYPE_CHECKING

import pytest
from _pytest.faulthandler import fault_handler_stderr_fd_key
from hypothesis import HealthCheck, settings

from swarm_loc_estimator.common.jit import is_precompiled
from swarm_loc_estimator.nodes.mapper_precompile import precompile as precompile_mapper
from swarm_loc_estimator.precompile import precompile, precompile_infrared

if TYPE_CHECKING:
    from node_world import Ros  # unit tests do without ROS

# Each run draws examples of its own; where CI is set all draw the same, so that only a change can break a
# test there. How long an example takes says nothing: the machine may be busy, the first call may compile.
settings.register_profile(
    "workspace", derandomize="CI" in os.environ, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("workspace")


PRECOMPILED: list[Callable[[], None]] = [
    partial(precompile, "small", False),
    precompile_infrared,
    precompile_mapper,
    *(partial(precompile, size, infrared) for infrared in (False, True) for size in ("large", "sparse")),
]
"""What tests and a wheel of compiled code need; two processes compile it side by side."""
if find_spec("swarm_loc_vision"):  # colcon tests the estimator without it
    from swarm_loc_vision.markers.detector import precompile as precompile_detector

    PRECOMPILED.insert(2, precompile_detector)


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile before any test's time runs, once and not in every worker."""
    if hasattr(session.config, "workerinput") or all(map(is_precompiled, PRECOMPILED)):
        return
    print("compiling all inner loops for this machine: about two minutes", flush=True)
    with ProcessPoolExecutor(2, get_context("spawn")) as processes:
        for done in [processes.submit(one) for one in PRECOMPILED]:
            done.result()


def pytest_collection_finish() -> None:
    """Let the garbage collector pass over all modules and tests: they stay, and are looked through else."""
    gc.freeze()


@pytest.fixture(autouse=True)
def _own_ros_domain(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Give a test under `test/node` a domain that no other test on this machine has at the same time.

    Only UDP is used, since tests kill processes: Fast DDS 2.14 may crash at exit after a process that shared
    memory with it was killed.
    """
    if "node" not in request.path.parts:
        yield
        return
    from domain_coordinator import domain_id  # noqa: PLC0415 - unit tests do without ROS

    with domain_id() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
        yield


@pytest.fixture
def ros(pytestconfig: pytest.Config) -> Iterator[Ros]:
    """ROS, for one node test."""
    from node_world import Ros  # noqa: PLC0415 - unit tests do without ROS

    ros = Ros()
    # rclpy's executor directs the stacks of a crash to sys.stderr, which pytest captures and loses.
    faulthandler.enable(pytestconfig.stash[fault_handler_stderr_fd_key])
    yield ros
    ros.close()


@pytest.fixture
def frequent_diagnostics(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let nodes say at once what a test waits for."""
    monkeypatch.setattr("swarm_loc_estimator.common.node._DIAGNOSTICS_PERIOD_S", 0.05)
