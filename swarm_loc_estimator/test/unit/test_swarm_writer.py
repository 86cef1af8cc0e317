"""The swarm description: what is written is read back, and shared things are written once."""

import string
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from swarm_loc_estimator.common.parameters import number_specs
from swarm_loc_estimator.swarm.error_models import (
    ClockModel,
    FixModel,
    MotionResponse,
    OdometryModel,
    RandomWalk,
    SensorModel,
)
from swarm_loc_estimator.swarm.ir_board import IrGains, RobotIr, load_ir_platform
from swarm_loc_estimator.swarm.swarm import CameraMount, Face, Landmark, Robot, StartSigma, Swarm
from swarm_loc_estimator.swarm.swarm_file import RESERVED_NAMES, load_swarm, save_swarm

RESPONSE = MotionResponse(
    (0.0, 0.1), (0.0, 0.5, 1.0), ((1.0, 0.9, 0.9), (1.0, 0.8, 0.7)), ((1.0, 0.9, 0.8),) * 2
)
DROPLET = load_ir_platform("droplet")
RELAXED = settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])


def numbers(cls: type) -> st.SearchStrategy[dict[str, Any]]:
    options = {
        name: st.floats(spec.low, min(spec.high, 1e6), exclude_min=spec.above)
        | (st.none() if spec.optional else st.nothing())
        for name, spec in number_specs(cls).items()
    }
    return st.fixed_dictionaries({}, optional=options)


def build(cls: type) -> st.SearchStrategy[Any]:
    return numbers(cls).map(lambda values: cls(**values))


def boards(board_id: int) -> st.SearchStrategy[RobotIr]:
    gain = st.tuples(*[st.floats(0.05, 20.0)] * 6)
    return st.builds(
        RobotIr,
        st.just(board_id),
        st.just(DROPLET),
        st.just("droplet"),
        st.none() | st.builds(IrGains, gain, gain, st.floats(0.0, 1.0), st.floats(0.0, 1.0)),
        gate_probability=st.floats(0.5, 1.0),
    )


@st.composite
def swarms(draw: st.DrawFn) -> Swarm:
    ids = iter(draw(st.lists(st.integers(0, 2**32 - 1), unique=True, min_size=40, max_size=40)))
    names = draw(
        st.lists(
            st.text(string.ascii_letters, min_size=1, max_size=6).filter(lambda n: n not in RESERVED_NAMES),
            unique=True,
            min_size=1,
            max_size=4,
        )
    )
    robots: list[Robot] = []
    kinds = (OdometryModel, RandomWalk, CameraMount, SensorModel, FixModel, ClockModel, StartSigma)
    pool = {cls: [cls(), draw(build(cls))] for cls in kinds}
    face_numbers = draw(st.lists(numbers(Face), max_size=3))
    for name in names:
        faces = tuple(Face(f"f{k}", next(ids), **values) for k, values in enumerate(face_numbers))
        stands = draw(st.booleans())
        robots.append(
            Robot(
                name,
                draw(st.sampled_from(["", "typ", "other"])),
                odometry=OdometryModel() if stands else draw(st.sampled_from(pool[OdometryModel])),
                response=draw(st.sampled_from([None, RESPONSE])),
                camera=draw(st.sampled_from([*pool[CameraMount], None])),
                sensor=draw(st.sampled_from(pool[SensorModel])),
                faces=faces[: draw(st.integers(0, 3))],
                start=draw(
                    st.none() | st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.floats(-6.28, 6.28))
                ),
                fix=draw(st.sampled_from(pool[FixModel])),
                clock=draw(st.sampled_from(pool[ClockModel])),
                start_sigma=draw(st.sampled_from(pool[StartSigma])),
                stands=stands,
                random_walk=draw(st.sampled_from(pool[RandomWalk])) if stands else RandomWalk(),
                ir=draw(st.none() | boards(len(robots) + 1)),
            )
        )
    landmarks = tuple(
        Landmark(next(ids), **values) for values in draw(st.lists(numbers(Landmark), max_size=4))
    )
    return Swarm(tuple(robots), landmarks)


@RELAXED
@given(swarm=swarms())
def test_what_is_written_is_read_back(tmp_path: Path, swarm: Swarm) -> None:
    save_swarm(swarm, tmp_path / "swarm.yaml", "a comment\nof two lines")
    assert load_swarm(tmp_path / "swarm.yaml") == swarm


def test_written_file_says_shared_things_once(tmp_path: Path) -> None:
    model = OdometryModel(distance_scale=0.9)
    robots = tuple(
        Robot(name, "typ", model, sensor=SensorModel(bearing_offset=k)) for k, name in enumerate("ab")
    )
    save_swarm(Swarm(robots), tmp_path / "swarm.yaml")
    text = (tmp_path / "swarm.yaml").read_text()
    assert text.count("distance_scale: 0.9") == 1
    assert "bearing_offset [rad]" in text
