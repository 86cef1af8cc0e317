"""The Droplet's driver in its thread, over real pseudo-terminals, also bad ones."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from background import Background
from droplet_rig import IDEAL, IDS, LINK, NOISE, SECOND, TRIANGLE, world_of

from swarm_loc_drivers.common.odometry import OdometryState
from swarm_loc_drivers.droplet.driver import OWN, DropletDriver, DropletListeners
from swarm_loc_drivers.droplet.exchange import Brightness
from swarm_loc_drivers.droplet.parameters import DropletParameters
from swarm_loc_drivers.sim.droplet.firmware import DropletFirmware
from swarm_loc_drivers.sim.droplet.world import STEP_NS, DropletWorld, SimulatedDroplet, nominal_gait
from swarm_loc_drivers.sim.link_host import FirmwareHost
from swarm_loc_estimator.common import se2
from swarm_loc_estimator.common.arrays import FloatArray

PATIENCE_S = 60.0
SPEED = nominal_gait(0).velocity[0]


class Emulator:
    """A world in a thread, twice as fast as real time, with the first robot on a pseudo-terminal."""

    def __init__(self, world: DropletWorld, device: Path) -> None:
        self.world = world
        self._host = FirmwareHost()
        robots = [DropletFirmware(SimulatedDroplet(world, robot)) for robot in range(len(world.ids))]
        self._host.serve_pty(robots[0], device)
        self._others = robots[1:]
        self._background = Background(self._step)

    def _step(self) -> None:
        self.world.step()
        for robot in self._others:
            robot.stream()
        self._host.poll(0.5 * STEP_NS / SECOND)

    @property
    def moves(self) -> bool:
        """Whether any robot moves."""
        return bool(self.world._twists.any())

    def kill(self) -> None:
        """Switch it off."""
        self._background.end()
        self._host.close()


class Desk:
    """A driver, what it reports, and the velocity that it is commanded again and again."""

    def __init__(self, params: DropletParameters, clock: Callable[[], int]) -> None:
        self.states: dict[str, list[OdometryState]] = {name: [] for name in (OWN, *params.relayed_ids)}
        self.matrices: list[Brightness] = []
        self.velocity: dict[str, tuple[float, float, float]] = {}
        listeners = DropletListeners(
            lambda name, state: self.states[name].append(state), lambda _, one: self.matrices.append(one)
        )
        self.driver = DropletDriver(params, listeners, clock)
        self.driver.start()
        self._ticker = Background(self._tick, 0.01)

    def _tick(self) -> None:
        for name, velocity in self.velocity.items():
            self.driver.set_velocity(name, velocity)

    def until(self, condition: Callable[[], object]) -> None:
        """Wait until something is so."""
        end_s = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < end_s, (self.driver.trouble, self.driver.counts)
            time.sleep(0.005)

    def stop(self) -> None:
        """End."""
        self._ticker.end()
        self.driver.stop()


class Lab:
    """Makes emulators and drivers, and ends them."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.device, self._stack = folder / "droplet", stack
        self.world = world_of()

    def emulator(self, world: DropletWorld | None = None) -> Emulator:
        """The robots, always at the same port."""
        self.world = world or self.world
        emulator = Emulator(self.world, self.device)
        self._stack.callback(emulator.kill)
        return emulator

    def desk(self, *partners: int, **relayed: int) -> Desk:
        """A driver at work."""
        params = DropletParameters(
            address=str(self.device),
            partners=tuple(f"{one:X}" for one in partners),
            exchange_rate=0.0,
            walk_noise=NOISE.walk_noise,
            veer_noise=NOISE.veer_noise,
            turn_noise=NOISE.turn_noise,
            cmd_vel_timeout_s=1.0,
            odom_rate=10.0,
            relayed=tuple(f"{name}={one:X}" for name, one in relayed.items()),
        )
        desk = Desk(params, lambda: self.world.now_ns)
        self._stack.callback(desk.stop)
        return desk


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    with ExitStack() as stack:
        yield Lab(tmp_path, stack)


def moved(world: DropletWorld, robot: int = 0) -> FloatArray:
    """Where a robot is now, as seen from where it began."""
    return se2.between(TRIANGLE[robot], world.poses[robot])


def test_it_walks_as_told_and_measures_on_request(lab: Lab) -> None:
    emulator = lab.emulator()
    desk = lab.desk(*IDS[1:])
    desk.until(lambda: desk.states[OWN])
    desk.velocity[OWN] = (0.01, 0.0, 0.0)
    desk.until(lambda: desk.states[OWN][-1].pose[0] > 0.012)
    desk.velocity[OWN] = (0.0, 0.0, 0.0)
    desk.until(lambda: not desk.states[OWN][-1].twist.any())
    desk.until(lambda: not emulator.moves)
    pose = desk.states[OWN][-1].pose
    assert moved(lab.world) == pytest.approx(pose, abs=4e-3)  # a busy machine reads echoes late
    desk.driver.request_exchanges()
    desk.until(lambda: len(desk.matrices) == 4)
    assert {one.transmitter for one in desk.matrices} == set(IDS[1:])
    stamps = np.array([state.stamp_ns for state in desk.states[OWN]])
    assert (np.diff(stamps) > 0).all()
    assert desk.driver.trouble == ""


def test_a_robot_without_a_cable_is_driven_through_the_one_that_has_it(lab: Lab) -> None:
    errors = replace(IDEAL, infrared=replace(LINK, loss=0.0))
    lab.emulator(world_of(errors=errors))
    desk = lab.desk(other=IDS[1])
    desk.until(lambda: desk.states["other"])
    desk.velocity["other"] = (-0.01, 0.0, 0.0)
    desk.until(lambda: desk.states["other"][-1].pose[0] < -0.008)
    desk.stop()
    last = desk.states["other"][-1]
    assert moved(lab.world, 1)[0] == pytest.approx(last.pose[0], abs=4e-3)
    assert last.covariance[0, 0] > 0.05 * 0.006**2  # it may not have heard
    assert not moved(lab.world).any()


@pytest.mark.parametrize("how", ["stop", "silence"])
def test_the_robot_stands_at_the_end_and_when_velocities_stop_coming(lab: Lab, how: str) -> None:
    emulator = lab.emulator()
    desk = lab.desk()
    desk.until(lambda: desk.states[OWN])
    desk.velocity[OWN] = (0.01, 0.0, 0.0)
    desk.until(lambda: emulator.moves)
    if how == "stop":
        desk.driver.stop()
        assert not emulator.moves
    else:
        desk.velocity.clear()
        desk.until(lambda: desk.driver.counts["stale_cmd_vel"])
        desk.until(lambda: not emulator.moves)


def test_a_robot_whose_cable_was_pulled_is_found_again(lab: Lab) -> None:
    emulator = lab.emulator()
    desk = lab.desk()
    desk.velocity[OWN] = (0.01, 0.0, 0.0)
    desk.until(lambda: emulator.moves and desk.states[OWN])
    emulator.kill()
    desk.until(lambda: desk.driver.trouble)
    before = desk.states[OWN][-1]
    again = lab.emulator()  # the same world: the robot has gone on meanwhile
    desk.until(lambda: not desk.driver.trouble)
    desk.until(lambda: again.moves and desk.states[OWN][-1].covariance[0, 0] > before.covariance[0, 0])
    assert desk.driver.counts["connections"] == 2
    assert desk.driver.counts["link_failures"] >= 1
    desk.stop()


def test_a_port_that_is_not_there_is_named_and_waited_for(lab: Lab) -> None:
    desk = lab.desk()
    desk.until(lambda: desk.driver.counts["link_failures"] >= 2)
    assert str(lab.device) in desk.driver.trouble
    lab.emulator()
    desk.until(lambda: desk.states[OWN])
    assert desk.driver.trouble == ""
    desk.stop()
