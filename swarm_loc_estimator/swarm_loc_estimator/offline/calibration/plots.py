"""Table and plots of a calibration: residuals before and after."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.offline.calibration.camera import CameraFit
from swarm_loc_estimator.offline.calibration.fit import Calibration
from swarm_loc_estimator.offline.calibration.noise import Score
from swarm_loc_estimator.offline.calibration.robust import spread
from swarm_loc_estimator.offline.report.style import INK, SOFT, TRUTH, colour_of, save, style
from swarm_loc_estimator.swarm.error_models import MotionResponse

_BINS = 60
_COLUMNS = 3
_SIGHTING_LABELS = {True: ("range [m]", "bearing [rad]"), False: ("forward [m]", "left [m]", "heading [rad]")}
"""Of the errors of polar sightings and of poses."""
_MOTION_LABELS = ("path [m]", "turn [rad]")


def text_of(done: Calibration) -> str:
    """The residuals before and after, the fitted noise and the remarks."""
    lines = [f"{'':34}{'before':>10}{'after':>10}"]
    for fit in done.models.cameras:
        errors = _sighting_errors([fit] if fit.count else [])
        lines += [
            _line(f"{fit.robot.name} {label}", spread(before), spread(after))
            for label, before, after in errors
        ]
    for motion in done.models.motion:
        lines += [
            _line(f"motion over 5 s, {label}", spread(motion.before[:, k]), spread(motion.after[:, k]))
            for k, label in enumerate(_MOTION_LABELS)
        ]
        late = motion.late
        lines.append(f"delay {late.delay_s:.3f} s, lag {late.lag_s:.3f} s")
    if done.before is not None and done.after is not None:
        lines += _score_lines(done.before, done.after)
    lines += [f"{name} = {value:g}" for name, value in done.noise.items()]
    return "\n".join([*lines, *done.models.remarks, *([done.warning] if done.warning else [])])


def draw(done: Calibration, path: Path) -> Path:
    """Plot residuals before and after, and the table of scale factors; returns the file."""
    responses = [motion.response for motion in done.models.motion if motion.response is not None]
    response = responses[0] if responses and len(responses[0].speeds) > 1 else None
    panels = _panels(done)
    count = len(panels) + 2 * (response is not None)
    columns = min(_COLUMNS, max(1, count))
    rows = -(-count // columns)
    figure = Figure(figsize=(3.6 * columns, 2.9 * rows))
    axes: list[Any] = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for axis, (label, before, after) in zip(axes, panels, strict=False):
        _histogram(axis, label, before, after)
    if response is not None:
        for axis, name in zip(axes[len(panels) :], ("speed", "turn rate"), strict=False):
            _shares(axis, response, name)
    for axis in axes[count:]:
        axis.set_visible(False)
    if panels:
        axes[0].legend(frameon=False, fontsize=9)
    save(figure, path)
    return path


def _sighting_errors(fits: Sequence[CameraFit]) -> Iterator[tuple[str, FloatArray, FloatArray]]:
    """Label, errors before and errors after of the sightings of some cameras."""
    for polar, labels in _SIGHTING_LABELS.items():
        rows = [fit.sightings.polar == polar for fit in fits]
        for k, label in enumerate(labels if any(one.any() for one in rows) else ()):
            before, after = (
                np.concatenate([getattr(fit, name)[one, k] for fit, one in zip(fits, rows, strict=True)])
                for name in ("before", "after")
            )
            yield label, before, after


def _score_lines(before: Score, after: Score) -> list[str]:
    """Errors of the estimator."""
    return [
        _line("estimator, position RMSE [m]", before.position_rmse, after.position_rmse),
        _line(
            "estimator, heading RMSE [deg]",
            math.degrees(before.heading_rmse),
            math.degrees(after.heading_rmse),
        ),
        _line("estimator, NEES (ideal 3)", before.nees, after.nees),
    ]


def _line(name: str, before: float, after: float) -> str:
    return f"{name:34}{before:10.3g}{after:10.3g}"


def _panels(done: Calibration) -> list[tuple[str, FloatArray, FloatArray]]:
    """Label, errors before and errors after of everything that was fitted."""
    errors = _sighting_errors(done.models.cameras)
    panels = [(f"sightings, {label}", before, after) for label, before, after in errors]
    for k, label in enumerate(_MOTION_LABELS if done.models.motion else ()):
        before, after = (
            np.concatenate([getattr(fit, name)[:, k] for fit in done.models.motion])
            for name in ("before", "after")
        )
        panels.append((f"motion over 5 s, {label}", before, after))
    return panels


def _histogram(axis: Any, label: str, before: FloatArray, after: FloatArray) -> None:
    """Histograms of the errors before and after."""
    reach = max(
        1e-6, 4.0 * max(spread(before - np.median(before)), spread(after)) + abs(float(np.median(before)))
    )
    bins = np.linspace(-reach, reach, _BINS)
    style(axis)
    axis.hist(before, bins, color=TRUTH, alpha=0.6, label="before")
    axis.hist(after, bins, histtype="step", color=colour_of(0), linewidth=1.6, label="after")
    axis.set_title(f"error of {label}", loc="left", fontsize=10, color=INK)
    axis.set_yticks([])
    axis.locator_params(axis="x", nbins=5)
    axis.spines["left"].set_visible(False)


def _shares(axis: Any, response: MotionResponse, name: str) -> None:
    """A coloured table of scale factors."""
    table = np.array(response.speed_share if name == "speed" else response.turn_share)
    axis.imshow(table, cmap="coolwarm", vmin=0.4, vmax=1.6, aspect="auto", origin="lower")
    for (row, column), share in np.ndenumerate(table):
        axis.text(column, row, f"{share:.2f}", ha="center", va="center", fontsize=8)
    axis.set_xticks(range(len(response.turn_rates)), [f"{v:.2f}" for v in response.turn_rates])
    axis.set_yticks(range(len(response.speeds)), [f"{v:.3f}" for v in response.speeds])
    axis.tick_params(colors=SOFT, labelsize=8, length=0)
    axis.spines[:].set_visible(False)
    axis.set_title(f"true share of reported {name}", loc="left", fontsize=10, color=INK)
    axis.set_xlabel("turn rate [rad/s]", color=SOFT, fontsize=9)
    axis.set_ylabel("speed [m/s]", color=SOFT, fontsize=9)
