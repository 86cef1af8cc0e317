"""The driver against emulated robots over real pseudo-terminals and sockets, also bad ones."""

import math
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest
from epuck_body import GEOMETRY
from epuck_rig import PATIENCE_S, SQUARE, Mute, Robots, params_of

from swarm_loc_drivers.epuck.hardware import EPUCK1
from swarm_loc_estimator.common import se2


@pytest.fixture
def robots(tmp_path: Path) -> Iterator[Robots]:
    with ExitStack() as emulators, ExitStack() as benches:  # drivers end while their robots answer
        yield Robots(tmp_path, emulators, benches)


@pytest.mark.parametrize("over", ["serial", "wifi"])
def test_the_robot_stands_when_the_driver_has_ended(robots: Robots, over: str) -> None:
    emulator = robots.serial() if over == "serial" else robots.wifi()
    address = robots.serial_address if over == "serial" else robots.tcp_address
    bench = robots.bench(params_of(address))
    bench.velocity = (0.06, 0.5)
    bench.until(lambda: any(emulator.body.rates))
    bench.driver.stop()
    assert emulator.body.rates == (0.0, 0.0)


@pytest.mark.parametrize("over", ["serial", "wifi"])
def test_the_robot_stands_when_velocities_stop_coming(robots: Robots, over: str) -> None:
    emulator = robots.serial(EPUCK1) if over == "serial" else robots.wifi()
    address = robots.serial_address if over == "serial" else robots.tcp_address
    bench = robots.bench(params_of(address, "epuck1" if over == "serial" else "epuck2"))
    bench.velocity = (0.06, 0.0)
    bench.until(lambda: any(emulator.body.rates))
    bench.fall_silent()
    bench.until(lambda: not any(emulator.body.rates))
    assert bench.driver.counts["stale_cmd_vel"] >= 1  # more where the machine paused before, too


@pytest.mark.parametrize("over", ["serial", "wifi"])
def test_a_robot_switched_off_and_on_is_found_again(robots: Robots, over: str) -> None:
    start = robots.serial if over == "serial" else robots.wifi
    emulator = start()
    address = robots.serial_address if over == "serial" else robots.tcp_address
    # the link fails when it is broken here, and not while an emulated robot waits for a processor
    bench = robots.bench(replace(params_of(address), reply_timeout_s=10.0))
    bench.drive(SQUARE[:1])
    emulator.kill()
    bench.until(lambda: bench.driver.trouble)
    before = bench.states[-1]

    again = start()  # its counters and its place in the world begin at zero
    bench.until(lambda: not bench.driver.trouble)
    bench.until(lambda: bench.states[-1].stamp_ns > before.stamp_ns)
    found = bench.states[-1].pose
    origin = again.body.pose
    bench.drive(SQUARE[1:3])
    driven, true = se2.between(found, bench.states[-1].pose), se2.between(origin, again.body.pose)
    assert driven == pytest.approx(true, abs=5e-3)
    assert bench.driver.counts["connections"] == 2
    assert bench.driver.counts["link_failures"] >= 1


@pytest.mark.parametrize("over", ["serial", "wifi"])
def test_a_cut_link_costs_no_odometry_of_a_robot_that_runs_on(robots: Robots, over: str) -> None:
    start = robots.serial if over == "serial" else robots.wifi
    emulator = start()
    address = robots.serial_address if over == "serial" else robots.tcp_address
    bench = robots.bench(params_of(address))
    bench.velocity = (0.06, 0.4)
    bench.until(lambda: any(emulator.body.rates) and len(bench.states) > 10)
    emulator.kill()
    bench.until(lambda: bench.driver.trouble)
    start(body=emulator.body)
    bench.until(lambda: not bench.driver.trouble)
    bench.drive(SQUARE[:1])
    error = se2.between(emulator.body.pose, bench.states[-1].pose)
    assert math.hypot(error[0], error[1]) <= 5e-3
    assert abs(error[2]) <= 2.1 * GEOMETRY.metres_per_step / GEOMETRY.wheel_separation
    assert not bench.driver.counts["counter_restarts"]


def test_a_port_that_is_not_there_is_named_and_waited_for(robots: Robots) -> None:
    bench = robots.bench(params_of(robots.serial_address, "epuck1"))
    bench.until(lambda: bench.driver.counts["link_failures"] >= 2)
    assert robots.serial_address in bench.driver.trouble
    robots.serial(EPUCK1)
    bench.until(lambda: bench.states)
    assert bench.driver.trouble == ""


def test_a_port_where_nobody_speaks_the_language_is_told(robots: Robots) -> None:
    robots.serial(EPUCK1, wrap=lambda _: Mute())
    quick = replace(params_of(robots.serial_address, "epuck1"), reply_timeout_s=0.02)
    bench = robots.bench(quick)
    bench.until(lambda: "does not answer" in bench.driver.trouble)


def test_stopping_while_the_link_is_down_still_stops_the_robot(robots: Robots) -> None:
    emulator = robots.wifi()
    bench = robots.bench(params_of(robots.tcp_address))
    bench.velocity = (0.06, 0.0)
    bench.until(lambda: any(emulator.body.rates))
    emulator.kill()
    bench.until(lambda: bench.driver.trouble)
    ending = threading.Thread(target=bench.driver.stop)
    ending.start()
    robots.wifi(body=emulator.body)
    ending.join(PATIENCE_S)
    assert emulator.body.rates == (0.0, 0.0)
