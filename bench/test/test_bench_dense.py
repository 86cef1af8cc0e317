"""The dense block: who sees what, and that it keeps its formation."""

import numpy as np

from bench.epuck.dense import PITCH, DenseSettings, blind_robots, simulate_dense


def test_the_inner_robots_see_robots_but_no_landmark_and_others_see_both() -> None:
    run = simulate_dense(DenseSettings(seed=3, duration_s=6.0))
    observer = np.repeat(run.frames["robot"], run.frames["count"])
    of_landmark = np.isin(run.sightings["marker_id"], [mark.id for mark in run.swarm.landmarks])
    inner = np.isin(observer, blind_robots())
    assert blind_robots().tolist() == [6, 7, 8, 11, 12, 13]
    assert not (of_landmark & inner).any()
    assert (~of_landmark & inner).sum() > 100
    assert (of_landmark & ~inner).sum() > 100
    assert run.frames["first"].tolist() == (np.cumsum(run.frames["count"]) - run.frames["count"]).tolist()


def test_a_seed_keeps_its_run() -> None:
    one, again, other = (simulate_dense(DenseSettings(seed=seed, duration_s=1.0)) for seed in (4, 4, 5))
    assert one.sightings.size > 100
    np.testing.assert_array_equal(one.sightings, again.sightings)
    assert one.sightings.tobytes() != other.sightings.tobytes()


def test_neighbours_keep_their_distance() -> None:
    run = simulate_dense(DenseSettings(seed=4, duration_s=20.0))
    poses = run.truth.poses[::50]
    apart = np.linalg.norm(poses[:, 1, :2] - poses[:, 0, :2], axis=-1)
    assert apart.min() > 0.6 * PITCH
    assert apart.max() < 1.4 * PITCH
