"""What all scenarios share: a run with a fault, its time, who is guilty, and the errors of the worlds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from swarm_loc_drivers.sim.run import LivedRun
from swarm_loc_drivers.sim.scenarios.eight import EightSettings
from swarm_loc_drivers.sim.worlds import W0, W2, ErrorModel
from swarm_loc_estimator.swarm.error_models import SensorModel

DURATION_S = 60.0
FAULT_S = (15.0, 45.0)

DETECTOR = SensorModel(forward_sigma=0.005, left_sigma=0.002, heading_sigma=0.06)  # Noise as described
CLEAN = replace(W0, forward_sigma=0.005, left_sigma=0.002, heading_sigma=0.06, described=DETECTOR)
SYSTEMATIC = replace(W2, forward_sigma=0.005, left_sigma=0.002, heading_sigma=0.06, described=DETECTOR)
"""Systematic errors of w2 that the description does not contain."""


@dataclass(frozen=True)
class Fault:
    """A run with a fault."""

    run: LivedRun  # The run
    # End of the fault, after which the estimate should recover; None: it does not end
    ends_s: float | None = None
    # Begin and end of the time in which no data that has arrived shows the fault
    hidden_s: tuple[float, float] | None = None
    about: str = ""  # Name of the faulty robot or landmark, if it depends on the seed
    # Readings by sensor besides odometry and sightings of the run, or in place of these
    readings: Mapping[str, Any] = field(default_factory=dict)
    healthy: Mapping[str, Any] = field(default_factory=dict)  # The same without the fault
    begins_s: float = 0.0  # Begin of the fault
    guilty: frozenset[str] = frozenset()  # Names that a contradiction may be about
    concerned: frozenset[int] = frozenset()  # Robots that the fault concerns, if not all of them


def settings_of(seed: int, errors: ErrorModel, duration_s: float = DURATION_S) -> EightSettings:
    """Five robots, for a minute unless told otherwise."""
    return EightSettings(seed=seed, duration_s=duration_s, errors=errors)
