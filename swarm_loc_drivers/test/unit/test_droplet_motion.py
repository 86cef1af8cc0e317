"""From velocities to a Droplet's few motions, and from commands to poses and how sure they are."""

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from droplet_rig import IDEAL, IDS, NOISE, SECOND, START_NS, TRIANGLE, Lab, asking, world_of
from hypothesis import given
from hypothesis import strategies as st

from swarm_loc_drivers.common.robot_driver import VelocityCommand
from swarm_loc_drivers.droplet.driver import DropletMover, nearest_motion
from swarm_loc_drivers.droplet.hardware import AUDIO_DROPLET, DIRECTIONS, ELEMENTS, Gait
from swarm_loc_drivers.droplet.odometry import CommandedMotion, MotionNoise
from swarm_loc_drivers.droplet.protocol import ConsoleTalk, Talk
from swarm_loc_drivers.sim.droplet.world import STEP_NS, nominal_gait
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray

GAITS = {direction: nominal_gait(direction) for direction in DIRECTIONS}
AHEAD, TURN = GAITS[0], GAITS[7]
SPEED = AHEAD.velocity[0]


@given(angle=st.floats(-math.pi, math.pi), speed=st.floats(0.7 * SPEED, 1.0))
def test_the_nearest_of_six_directions_is_walked(angle: float, speed: float) -> None:
    chosen = nearest_motion((speed * math.cos(angle), speed * math.sin(angle), 0.0), GAITS)
    assert chosen is not None
    assert chosen < 6
    forward, left, _ = GAITS[chosen].velocity
    off = abs(float(se2.wrap_angle(math.atan2(left, forward) - angle)))
    assert off <= math.radians(30.0) + 1e-6


@pytest.mark.parametrize(
    ("velocity", "chosen"),
    [
        ((0.0, 0.0, 0.0), None),
        ((0.4 * SPEED, 0.0, 0.0), None),
        ((0.0, 0.0, 0.4 * TURN.velocity[2]), None),
        ((-0.1, 0.0, 0.0), 3),
        ((0.0, -0.1, 0.001), 1),
        ((0.0, 0.0, 3.0), 7),
        ((0.001, 0.0, -3.0), 6),
    ],
)
def test_what_is_chosen(velocity: tuple[float, float, float], chosen: int | None) -> None:
    found = nearest_motion(velocity, GAITS)
    assert found == chosen or {found, chosen} == {1, 2}  # straight to the right lies between the two


def test_who_cannot_walk_sideways_does_not() -> None:
    gaits = {direction: GAITS[direction] for direction in AUDIO_DROPLET.directions}
    assert nearest_motion((0.02, 0.01, 0.0), gaits) == 0
    assert nearest_motion((0.0, 0.1, 0.0), gaits) is None


def ending_at(motion: CommandedMotion, seconds: float) -> FloatArray:
    return motion.state(START_NS + round(seconds * SECOND)).pose


def test_motion_is_believed_until_its_steps_are_done() -> None:
    motion = CommandedMotion(NOISE)
    motion.state(START_NS)
    motion.begin(START_NS, AHEAD, 100)
    end_s = 100 * AHEAD.step_s
    assert ending_at(motion, 0.5 * end_s) == pytest.approx([50 * AHEAD.forward, 0.0, 0.0])
    assert motion.moving(START_NS + round(0.99 * end_s * SECOND))
    assert motion.state(START_NS + round(0.6 * end_s * SECOND)).twist == pytest.approx(AHEAD.velocity)
    assert ending_at(motion, 2.0 * end_s) == pytest.approx([100 * AHEAD.forward, 0.0, 0.0])
    assert not motion.moving(START_NS + round(1.01 * end_s * SECOND))
    assert not motion.state(START_NS + round(2.0 * end_s * SECOND)).twist.any()


def test_who_moves_does_not_begin_anew_before_it_has_stopped() -> None:
    motion = CommandedMotion(NOISE)
    motion.begin(START_NS, AHEAD, 100)
    motion.begin(START_NS + SECOND, TURN, 100)
    assert ending_at(motion, 2.0)[2] == 0.0
    motion.stop(START_NS + 2 * SECOND)
    motion.begin(START_NS + 2 * SECOND, TURN, 100)
    assert ending_at(motion, 3.0)[2] == pytest.approx(TURN.velocity[2])


@given(cuts=st.lists(st.floats(0.0, 12.0), max_size=20))
def test_how_often_one_looks_does_not_matter(cuts: list[float]) -> None:
    looked, plain = CommandedMotion(NOISE), CommandedMotion(NOISE)
    for motion, looks in ((looked, sorted(cuts)), (plain, [])):
        motion.state(START_NS)
        for begin_s, gait in ((0.0, GAITS[2]), (4.0, TURN), (8.0, AHEAD)):
            for look_s in looks:
                if begin_s - 4.0 <= look_s < begin_s:
                    motion.state(START_NS + round(look_s * SECOND))
            motion.stop(START_NS + round(begin_s * SECOND))
            motion.begin(START_NS + round(begin_s * SECOND), gait, 1000)
    one, other = looked.state(START_NS + 12 * SECOND), plain.state(START_NS + 12 * SECOND)
    assert one.pose == pytest.approx(other.pose, abs=1e-12)
    assert one.covariance == pytest.approx(other.covariance, abs=1e-12)
    assert np.linalg.eigvalsh(one.covariance)[0] > 0.0


def test_time_that_jumps_back_leaves_the_robot_where_it_is() -> None:
    motion = CommandedMotion(NOISE)
    motion.begin(START_NS, AHEAD, 100)
    there = ending_at(motion, 2.0)
    assert ending_at(motion, -100.0) == pytest.approx(there)
    assert ending_at(motion, -50.0) == pytest.approx(there)


def hold(console: ConsoleTalk, talk: Talk[None]) -> None:
    """Have a talk with a robot that echoes at once."""
    while True:
        try:
            due_ns = next(talk)
        except StopIteration:
            return
        output = console.take_output()
        console.hear(output.replace(b"\r", b"\r\n"), console.now_ns if output else due_ns)


@pytest.mark.parametrize("loss", [0.1, 1.0])
def test_what_was_relayed_is_in_doubt_by_the_share_of_commands_that_are_lost(loss: float) -> None:
    motion = CommandedMotion(MotionNoise(0.0, 0.0, 0.0))
    console = ConsoleTalk(ELEMENTS, SECOND, lambda _: None, Counter())
    console.hear(b"", START_NS)
    command = VelocityCommand(1.0, lambda: START_NS, Counter())
    command.set((0.01, 0.0, 0.0))
    mover = DropletMover(command, motion, 2.0, IDS[1], loss)
    hold(console, mover.send(console, GAITS))
    console.hear(b"", console.now_ns + SECOND)
    walked = motion.state(console.now_ns)
    # the error is all of the way, or nothing: so its mean square is that share of the way's
    assert walked.covariance[0, 0] == pytest.approx(loss * walked.pose[0] ** 2)
    hold(console, mover.stop(console))
    stopped = motion.state(console.now_ns)
    assert mover.asked is not None
    rest = mover.asked.steps * AHEAD.forward - stopped.pose[0]
    assert rest > 0.0
    squares = stopped.pose[0] ** 2 + rest**2
    assert stopped.covariance[0, 0] == pytest.approx(loss * squares)


def test_behind_a_broken_link_the_robot_may_stand_or_go_on() -> None:
    motion = CommandedMotion(NOISE)
    motion.begin(START_NS, AHEAD, 1000)
    motion.lose(START_NS + 5 * SECOND)
    before = motion.state(START_NS + 5 * SECOND).covariance
    motion.stop(START_NS + 15 * SECOND)
    grown = motion.state(START_NS + 15 * SECOND).covariance - before
    assert grown[0, 0] > (10.0 * SPEED) ** 2 / 3.0
    assert grown[0, 0] < 1.1 * (10.0 * SPEED) ** 2 / 3.0 + NOISE.walk_noise * 10.0 * SPEED


def test_the_covariance_is_that_of_robots_that_err_as_described() -> None:
    count = 250
    noise = MotionNoise(walk_noise=1e-4, veer_noise=0.5, turn_noise=0.02)
    errors = replace(
        IDEAL, walk_noise=noise.walk_noise, veer_noise=noise.veer_noise, turn_noise=noise.turn_noise
    )
    world = world_of(np.zeros((count, 3)), errors, range(1, count + 1))
    motion = CommandedMotion(noise)
    motion.state(world.now_ns)
    legs: list[tuple[int, Gait, int]] = [(2, GAITS[2], 40), (7, TURN, 20), (0, AHEAD, 50)]
    for direction, gait, steps in legs:
        motion.stop(world.now_ns)
        motion.begin(world.now_ns, gait, steps)
        for robot in range(count):
            world.move(robot, direction)
        for _ in range(round(steps * gait.step_s * 1e9 / STEP_NS)):
            world.step()
    state = motion.state(world.now_ns)
    errors_of = world.poses - state.pose
    errors_of[:, 2] = se2.wrap_angle(errors_of[:, 2])
    nees = np.einsum("ni,ij,nj->n", errors_of, np.linalg.inv(state.covariance), errors_of)
    # chi-square with 3 degrees of freedom has mean 3 and variance 6
    assert nees.mean() == pytest.approx(3.0, abs=5.0 * math.sqrt(6.0 / count))


def test_a_robot_follows_its_velocities() -> None:
    lab = Lab(world_of(np.array([[0.0, 0.0, 0.0]])), asking()).connected()
    (cable,) = lab.cables
    for velocity, seconds in (((0.01, 0.0, 0.0), 5.0), ((0.0, 0.0, 1.0), 7.0), ((-0.005, 0.008, 0.0), 4.0)):

        def keep_on(velocity: tuple[float, float, float] = velocity) -> None:
            cable.set_velocity(velocity)

        lab.control = keep_on
        lab.run(seconds)
    lab.control = lambda: None
    lab.run(5.0)
    state = cable.odometry()
    # the simulated motors stop up to 5 ms late, at the end of every stride
    assert lab.world.poses[0, :2] == pytest.approx(state.pose[:2], abs=3e-4)
    assert lab.world.poses[0, 2] == pytest.approx(state.pose[2], abs=3e-3)
    assert state.pose[2] == pytest.approx(7.0 * TURN.velocity[2], abs=0.06)
    assert cable.counts["stale_cmd_vel"] == 1
    assert not state.twist.any()


def test_a_move_that_somebody_else_commands_is_believed_too() -> None:
    lab = Lab(world_of(), asking(), asking()).connected()
    me, other = lab.cables
    other.firmware.receive(f"tgt_cmd {IDS[0]:04X} move_steps 0 20\r".encode())
    lab.run(5.0)
    assert me.counts["foreign_moves"] == 1
    assert me.odometry().pose == pytest.approx([20 * AHEAD.forward, 0.0, 0.0], abs=1e-6)
    moved = se2.between([0.0, 0.0, 0.3], lab.world.poses[0])
    assert moved == pytest.approx(me.odometry().pose, abs=1e-4)


def test_a_move_that_somebody_else_commands_does_not_end_the_own_one() -> None:
    lab = Lab(world_of(), asking()).connected()
    (cable,) = lab.cables
    lab.control = lambda: cable.set_velocity((0.01, 0.0, 0.0))
    lab.run(0.5)
    cable.session.step(b"walk direction 7, ", lab.world.now_ns)
    lab.run(0.01)
    assert cable.odometry().twist.any()
    lab.run(0.01)
    cable.session.step(b"num_steps 20\r\n", lab.world.now_ns)
    assert cable.counts["foreign_moves"] == 1
    lab.run(0.5)
    moved = se2.between(TRIANGLE[0], lab.world.poses[0])
    assert moved[0] > 0.8 * SPEED
    assert cable.odometry().pose == pytest.approx(moved, abs=1e-4)
