"""Law: compiled code that counts no references neither keeps nor releases an array of anybody."""

import gc
from collections.abc import Callable, Iterator

import pytest
from core_messages import T0
from core_run import on_time, play, settled, ticks
from core_world import Plan, simulate
from ir_world import droplet, random_poses, readings_of
from numba.core.runtime import _nrt_python  # type: ignore[attr-defined]
from numba.core.runtime.nrt import rtsys

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.jit import inlined_njit, norefcount_njit
from swarm_loc_estimator.infrared.likelihood import MaximumLikelihood
from swarm_loc_estimator.timeline.estimator import Estimator
from swarm_loc_estimator.timeline.settings import Policy, Settings


@pytest.fixture
def counted() -> Iterator[None]:
    """Numba counts what it allocates and frees."""
    _nrt_python.memsys_enable_stats()
    yield
    _nrt_python.memsys_disable_stats()


def held() -> int:
    """How many arrays compiled code holds, beyond those of before it counted."""
    gc.collect()
    stats = rtsys.get_allocation_stats()  # type: ignore[no-untyped-call]
    return int(stats.mi_alloc - stats.mi_free)


@pytest.mark.usefixtures("counted")
@pytest.mark.parametrize("many", [3, 1000])
def test_a_run_leaves_no_array_behind(many: int) -> None:
    """Of measurements used together, and one by one."""
    world = simulate(Plan(3, 4.0), 1)
    counts = []
    for _ in range(3):
        estimator = Estimator(world.swarm, Settings(policy=Policy(large_from=1, batch_from=many)))
        play(estimator, on_time(world), ticks(T0, int(world.stamp_ns[-1])))
        assert settled(estimator)["USED"] > 20
        del estimator
        counts.append(held())
    assert counts[0] == counts[1] == counts[2]


@pytest.mark.usefixtures("counted")
@pytest.mark.parametrize("element_sigma", [0.0, 0.1])
def test_solving_pairs_leaves_no_array_behind(element_sigma: float) -> None:
    """Neither of calls nor of pairs."""
    estimator = MaximumLikelihood(droplet(element_sigma))
    readings = readings_of(droplet(), random_poses(20, 1), 1)
    counts = []
    for pairs in (1, 20, 20):
        estimator.solve(readings[:pairs])
        counts.append(held())
    assert counts[0] == counts[1] == counts[2]


@pytest.mark.parametrize("borrow", [norefcount_njit, inlined_njit])
def test_what_borrows_arrays_returns_none(borrow: Callable[[Callable[..., object]], object]) -> None:
    def view(array: FloatArray) -> FloatArray:
        return array[:1]

    with pytest.raises(TypeError, match="numbers only"):
        borrow(view)
