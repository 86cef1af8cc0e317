"""Cooperative localization of a robot swarm; this module is its public Python API, see doc/python_api.md.

Names are loaded when they are first used: importing one of them loads only the modules that it needs.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

# The matrices are too small to share: where other programs run, BLAS threads wait for each other a hundred
# times longer than they compute. Must be set before numpy loads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

if TYPE_CHECKING:
    from swarm_loc_estimator.common.messages.streams import Messages as Messages
    from swarm_loc_estimator.filter.measurements import NOBODY as NOBODY
    from swarm_loc_estimator.filter.measurements import Measurements as Measurements
    from swarm_loc_estimator.filter.models import Prediction as Prediction
    from swarm_loc_estimator.infrared.brightness import expected_brightness as expected_brightness
    from swarm_loc_estimator.mapping.exploration import Goal as Goal
    from swarm_loc_estimator.mapping.grid import OccupancyMap as OccupancyMap
    from swarm_loc_estimator.mapping.map_file import load_map as load_map
    from swarm_loc_estimator.mapping.mapper import SCAN_TURN as SCAN_TURN
    from swarm_loc_estimator.mapping.mapper import START_TURN as START_TURN
    from swarm_loc_estimator.mapping.mapper import CooperativeMapper as CooperativeMapper
    from swarm_loc_estimator.mapping.mapper_feed import fix_covariance as fix_covariance
    from swarm_loc_estimator.mapping.messages import ScanMessage as ScanMessage
    from swarm_loc_estimator.mapping.messages import decode_laser as decode_laser
    from swarm_loc_estimator.mapping.scans import UNSEEN as UNSEEN
    from swarm_loc_estimator.mapping.scans import LightSightings as LightSightings
    from swarm_loc_estimator.mapping.scans import Readings as Readings
    from swarm_loc_estimator.offline.batch.smooth import smooth as smooth
    from swarm_loc_estimator.offline.export import read_truth as read_truth
    from swarm_loc_estimator.offline.metrics import Errors as Errors
    from swarm_loc_estimator.offline.metrics import ErrorSummary as ErrorSummary
    from swarm_loc_estimator.offline.recorded_bag import Loss as Loss
    from swarm_loc_estimator.offline.replay import replay as replay
    from swarm_loc_estimator.offline.report.report import write_report as write_report
    from swarm_loc_estimator.offline.result import ReplayResult as ReplayResult
    from swarm_loc_estimator.sensors.aerial import AerialRows as AerialRows
    from swarm_loc_estimator.sensors.camera import CONTENT_POSE as CONTENT_POSE
    from swarm_loc_estimator.sensors.camera import CONTENT_POSE_TWO as CONTENT_POSE_TWO
    from swarm_loc_estimator.sensors.camera import DetectionRows as DetectionRows
    from swarm_loc_estimator.sensors.fix import FixRows as FixRows
    from swarm_loc_estimator.sensors.imu import TurnRateRows as TurnRateRows
    from swarm_loc_estimator.sensors.infrared import BrightnessRows as BrightnessRows
    from swarm_loc_estimator.sensors.inputs import Batch as Batch
    from swarm_loc_estimator.sensors.inputs import register as register
    from swarm_loc_estimator.sensors.lidar import ScanRows as ScanRows
    from swarm_loc_estimator.sensors.odometry import OdometryRows as OdometryRows
    from swarm_loc_estimator.sensors.ranges import RangeRows as RangeRows
    from swarm_loc_estimator.sensors.sensor import Sensor as Sensor
    from swarm_loc_estimator.swarm.swarm import Anchor as Anchor
    from swarm_loc_estimator.swarm.swarm import CameraMount as CameraMount
    from swarm_loc_estimator.swarm.swarm import Face as Face
    from swarm_loc_estimator.swarm.swarm import FixedCamera as FixedCamera
    from swarm_loc_estimator.swarm.swarm import Landmark as Landmark
    from swarm_loc_estimator.swarm.swarm import Robot as Robot
    from swarm_loc_estimator.swarm.swarm import Swarm as Swarm
    from swarm_loc_estimator.swarm.swarm import UwbDevice as UwbDevice
    from swarm_loc_estimator.swarm.swarm_file import load_swarm as load_swarm
    from swarm_loc_estimator.swarm.swarm_file import save_swarm as save_swarm
    from swarm_loc_estimator.timeline.estimate import Estimate as Estimate
    from swarm_loc_estimator.timeline.estimate import Status as Status
    from swarm_loc_estimator.timeline.estimator import Estimator as Estimator
    from swarm_loc_estimator.timeline.estimator import Step as Step
    from swarm_loc_estimator.timeline.settings import Settings as Settings

_MODULES = {
    "swarm_loc_estimator.common.messages.streams": ("Messages",),
    "swarm_loc_estimator.filter.measurements": ("Measurements", "NOBODY"),
    "swarm_loc_estimator.filter.models": ("Prediction",),
    "swarm_loc_estimator.infrared.brightness": ("expected_brightness",),
    "swarm_loc_estimator.mapping.exploration": ("Goal",),
    "swarm_loc_estimator.mapping.grid": ("OccupancyMap",),
    "swarm_loc_estimator.mapping.map_file": ("load_map",),
    "swarm_loc_estimator.mapping.mapper": ("SCAN_TURN", "START_TURN", "CooperativeMapper"),
    "swarm_loc_estimator.mapping.mapper_feed": ("fix_covariance",),
    "swarm_loc_estimator.mapping.messages": ("ScanMessage", "decode_laser"),
    "swarm_loc_estimator.mapping.scans": ("UNSEEN", "LightSightings", "Readings"),
    "swarm_loc_estimator.offline.batch.smooth": ("smooth",),
    "swarm_loc_estimator.offline.export": ("read_truth",),
    "swarm_loc_estimator.offline.metrics": ("Errors", "ErrorSummary"),
    "swarm_loc_estimator.offline.recorded_bag": ("Loss",),
    "swarm_loc_estimator.offline.replay": ("replay",),
    "swarm_loc_estimator.offline.report.report": ("write_report",),
    "swarm_loc_estimator.offline.result": ("ReplayResult",),
    "swarm_loc_estimator.sensors.aerial": ("AerialRows",),
    "swarm_loc_estimator.sensors.camera": ("CONTENT_POSE", "CONTENT_POSE_TWO", "DetectionRows"),
    "swarm_loc_estimator.sensors.fix": ("FixRows",),
    "swarm_loc_estimator.sensors.imu": ("TurnRateRows",),
    "swarm_loc_estimator.sensors.infrared": ("BrightnessRows",),
    "swarm_loc_estimator.sensors.lidar": ("ScanRows",),
    "swarm_loc_estimator.sensors.odometry": ("OdometryRows",),
    "swarm_loc_estimator.sensors.ranges": ("RangeRows",),
    "swarm_loc_estimator.sensors.inputs": ("Batch", "register"),
    "swarm_loc_estimator.sensors.sensor": ("Sensor",),
    "swarm_loc_estimator.swarm.swarm": (
        "Anchor",
        "CameraMount",
        "Face",
        "FixedCamera",
        "Landmark",
        "Robot",
        "Swarm",
        "UwbDevice",
    ),
    "swarm_loc_estimator.swarm.swarm_file": ("load_swarm", "save_swarm"),
    "swarm_loc_estimator.timeline.estimate": ("Estimate", "Status"),
    "swarm_loc_estimator.timeline.estimator": ("Estimator", "Step"),
    "swarm_loc_estimator.timeline.settings": ("Settings",),
}
"""Module -> the names that it gives to the API; the same as are imported above for type checkers."""
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Load a name of the API, see PEP 562."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_MODULE_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The names of the API."""
    return sorted({*_MODULE_OF, *globals()})
