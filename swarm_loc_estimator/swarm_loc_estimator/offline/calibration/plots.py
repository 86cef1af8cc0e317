"""Tables and plots of calibrations: residuals before and after, gains and curves of infrared boards."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.infrared.brightness import curve_at
from swarm_loc_estimator.offline.calibration.fit import Calibration
from swarm_loc_estimator.offline.calibration.infrared.board import BLOCKS, BoardCalibration, BoardRecording
from swarm_loc_estimator.offline.calibration.infrared.elements import ElementVerdicts
from swarm_loc_estimator.offline.calibration.infrared.gains import BoardFit, InfraredCalibration, rms
from swarm_loc_estimator.offline.calibration.models import DriveFit
from swarm_loc_estimator.offline.calibration.sightings import CameraFit, spread
from swarm_loc_estimator.offline.report.plots import SOFT, TRUTH, colour_of, save, style
from swarm_loc_estimator.swarm.error_models import MotionResponse
from swarm_loc_estimator.swarm.ir_board import AngleCurve
from swarm_loc_estimator.swarm.swarm import Swarm

_BINS = 60
_COLUMNS = 3
_SIGHTING_LABELS = {True: ("range [m]", "bearing [rad]"), False: ("forward [m]", "left [m]", "heading [rad]")}
"""Of the errors of polar sightings and of poses."""
_MOTION_LABELS = ("path [m]", "turn [rad]")


def text_of(done: Calibration) -> str:
    """The residuals before and after, the fitted noise and the remarks."""
    lines = [f"{'':34}{'before':>10}{'after':>10}"]
    for fit in done.models.cameras:
        for label, before, after in _sighting_errors([fit] if fit.is_enough else []):
            lines.append(_line(f"{fit.robot.name} {label}", spread(before), spread(after)))
    for motion in done.models.motion:
        for label, before, after in _motion_errors([motion]):
            lines.append(_line(label, spread(before), spread(after)))
        lines.append(f"delay {motion.late.delay_s:.3f} s, lag {motion.late.lag_s:.3f} s")
    if done.before is not None and done.after is not None:
        degrees = [math.degrees(one.heading_rmse) for one in (done.before, done.after)]
        lines += [
            _line("estimator, position RMSE [m]", done.before.position_rmse, done.after.position_rmse),
            _line("estimator, heading RMSE [deg]", *degrees),
            _line("estimator, NEES (ideal 3)", done.before.nees, done.after.nees),
        ]
    lines += [f"{name} = {value:g}" for name, value in done.noise.items()]
    return "\n".join([*lines, *done.models.remarks, *filter(None, (done.gain, done.warning))])


def draw(done: Calibration, path: Path) -> Path:
    """Plot residuals before and after, and the table of scale factors; returns the file."""
    responses = [motion.response for motion in done.models.motion if motion.response is not None]
    response = responses[0] if responses and len(responses[0].speeds) > 1 else None
    seen = _sighting_errors(done.models.cameras)
    panels = [(f"sightings, {label}", before, after) for label, before, after in seen]
    panels += _motion_errors(done.models.motion)
    count = len(panels) + 2 * (response is not None)
    columns = min(_COLUMNS, max(1, count))
    rows = -(-count // columns)
    figure = Figure(figsize=(3.6 * columns, 2.9 * rows))
    axes: list[Any] = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for axis, (label, before, after) in zip(axes, panels, strict=False):
        off = abs(float(np.median(before)))
        reach = max(1e-6, 4.0 * max(spread(before - np.median(before)), spread(after)) + off)
        _histogram(axis, f"error of {label}", before, after, np.linspace(-reach, reach, _BINS))
        axis.locator_params(axis="x", nbins=5)
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
        rows = [fit.polar == polar for fit in fits]
        for k, label in enumerate(labels if any(one.any() for one in rows) else ()):
            before, after = (
                np.concatenate([getattr(fit, name)[one, k] for fit, one in zip(fits, rows, strict=True)])
                for name in ("before", "after")
            )
            yield label, before, after


def _line(name: str, before: float, after: float) -> str:
    return f"{name:34}{before:10.3g}{after:10.3g}"


def _motion_errors(fits: Sequence[DriveFit]) -> Iterator[tuple[str, FloatArray, FloatArray]]:
    """Label, errors before and errors after of the motion of some types."""
    for k, label in enumerate(_MOTION_LABELS if fits else ()):
        before, after = (
            np.concatenate([getattr(fit, name)[:, k] for fit in fits]) for name in ("before", "after")
        )
        yield f"motion over 5 s, {label}", before, after


def _histogram(axis: Any, title: str, before: FloatArray, after: FloatArray, bins: FloatArray) -> None:
    style(axis, title)
    axis.hist(before, bins, color=TRUTH, alpha=0.6, label="before")
    axis.hist(after, bins, histtype="step", color=colour_of(0), linewidth=1.6, label="after")
    axis.set_yticks([])
    axis.spines["left"].set_visible(False)


def _shares(axis: Any, response: MotionResponse, name: str) -> None:
    style(axis, f"true share of reported {name}", "turn rate [rad/s]", "speed [m/s]")
    axis.grid(visible=False)
    table = np.array(response.speed_share if name == "speed" else response.turn_share)
    axis.imshow(table, cmap="coolwarm", vmin=0.4, vmax=1.6, aspect="auto", origin="lower")
    for (row, column), share in np.ndenumerate(table):
        axis.text(column, row, f"{share:.2f}", ha="center", va="center", fontsize=8)
    axis.set_xticks(range(len(response.turn_rates)), [f"{v:.2f}" for v in response.turn_rates])
    axis.set_yticks(range(len(response.speeds)), [f"{v:.3f}" for v in response.speeds])
    axis.tick_params(length=0)
    axis.spines[:].set_visible(False)


_REACH = 6.0
_SIGMA_BINS = 61
_LEVELS = 12
_MIN_IN_LEVEL = 30


def gains_text(done: InfraredCalibration) -> str:
    """A table with one line per robot."""
    head = f"{'':16}{'exchanges':>10}{'before':>9}{'after':>9}{'own':>9}{'common':>9}"
    lines = [head, f"{'':16}{'used':>10}{'[sigma]':>9}{'[sigma]':>9}{'[%]':>9}{'[%]':>9}"]
    for board in done.boards:
        exchanges, used = board.group.exchanges, board.fit.used
        for place, index in enumerate(board.group.robots):
            count, before, after = board.of_robot(place)
            gains = board.fit.gains[place]
            lines.append(
                f"{done.swarm.robots[index].name:16}{count:10}{before:9.2f}{after:9.2f}"
                f"{100.0 * gains.sigma:9.2f}{100.0 * gains.common_sigma:9.2f}"
            )
        known = int(np.isfinite(exchanges.poses[used, 0]).sum())
        before, after = rms(board.fit.before), rms(board.fit.after)
        lines.append(
            f"platform {board.group.source}: {int(used.sum())} of {used.size} exchanges used, {known} of them"
            f" with ground truth; residuals {before:.2f} before, {after:.2f} after"
        )
        names = [done.swarm.robots[index].name for index in board.group.robots]
        lines += dead_lines(board.elements, names) + _limits(board, names)
    return "\n".join([*lines, *done.remarks])


def dead_lines(elements: ElementVerdicts, names: list[str]) -> list[str]:
    """A line per robot with dead elements, and one for undecided elements."""
    lines = []
    for place, name in enumerate(names):
        found = zip(("sensors", "emitters"), elements.numbers(place), strict=True)
        said = [f"{what} {list(numbers)}" for what, numbers in found if numbers]
        if said:
            lines.append(f"{name}: dead or shaded, left out: {', '.join(said)}")
    sensors, emitters = elements.undecided.sum(axis=(1, 2)).tolist()
    if sensors or emitters:
        count = elements.dead[0].size
        lines.append(
            f"not enough exchanges to say whether they are dead: {sensors} of {count} sensors,"
            f" {emitters} of {count} emitters"
        )
    return lines


def _limits(board: BoardFit, names: list[str]) -> list[str]:
    """A line per robot with saturation and noise by sensor, and one with the number of determined sensors."""
    limits, lines = board.limits, []
    columns = (
        ("saturation [count]", limits.saturation + board.group.platform.dark_level, 0),
        ("noise [count]", limits.noise, 2),
        ("relative noise [%]", 100.0 * limits.relative_noise, 1),
    )
    for place, name in enumerate(names):
        said = [
            f"{what} [{' '.join(f'{v:.{digits}f}' if np.isfinite(v) else '-' for v in values[place])}]"
            for what, values, digits in columns
            if np.isfinite(values[place]).any()
        ]
        if said:
            lines.append(f"{name}, by sensor: {', '.join(said)}")
    saturated, noisy = (int(np.isfinite(part).sum()) for part in (limits.saturation, limits.noise))
    lines.append(f"saturation determined for {saturated} of {limits.noise.size} sensors, noise for {noisy}")
    return lines


def draw_gains(done: InfraredCalibration, path: Path) -> Path:
    """Plot residuals before and after, in total and by brightness, and gains; one row per kind of board."""
    figure = Figure(figsize=(12.0, 3.2 * len(done.boards)))
    rows: list[Any] = list(figure.subplots(len(done.boards), 3, squeeze=False, width_ratios=(1.0, 1.0, 1.4)))
    for axes, board in zip(rows, done.boards, strict=True):
        before, after = (
            one[np.isfinite(one)].clip(-_REACH, _REACH) for one in (board.fit.before, board.fit.after)
        )
        bins = np.linspace(-_REACH, _REACH, _SIGMA_BINS)
        _histogram(axes[0], f"{board.group.source}: residuals [sigma]", before, after, bins)
        axes[0].legend(frameon=False, fontsize=9)
        _by_brightness(axes[1], board)
        _gains(axes[2], board, [done.swarm.robots[index].name for index in board.group.robots])
    save(figure, path)
    return path


def _by_brightness(axis: Any, board: BoardFit) -> None:
    """Residuals by brightness: wrong gains show in bright readings, blocked light in dark ones."""
    readings = board.group.exchanges.readings
    style(axis, "rms residual by brightness [sigma]", "reading [count]")
    for label, residuals, colour in (
        ("before", board.fit.before, TRUTH),
        ("after", board.fit.after, colour_of(0)),
    ):
        levels, sizes = _sizes(readings, residuals)
        axis.plot(levels, sizes, color=colour, marker=".", label=label)
    platform, limits = board.group.platform, board.limits
    noise, relative = limits.typical_noise
    if np.isfinite(noise):
        bright = np.array(levels)
        repeated = np.hypot(noise, np.nan_to_num(relative) * bright)
        repeated /= np.hypot(platform.noise, platform.relative * bright)
        (line,) = axis.plot(bright, repeated, color=colour_of(2), linewidth=0.8)
        axis.legend([line], ["noise where robots stand"], frameon=False, fontsize=9)
    for ceiling in limits.saturation[np.isfinite(limits.saturation)].tolist():
        axis.axvline(ceiling, color=SOFT, linewidth=0.3)
    axis.axhline(1.0, color=SOFT, linewidth=0.8, linestyle="--")
    axis.set_ylim(bottom=0.0)


def _sizes(readings: FloatArray, residuals: FloatArray) -> tuple[list[float], list[float]]:
    """Centres of brightness bins, and the RMS residuals in them."""
    known = np.isfinite(residuals)
    bright, error = readings[known], residuals[known]
    edges = np.linspace(bright.min(initial=0.0), bright.max(initial=1.0), _LEVELS + 1)
    level = np.digitize(bright, edges[1:-1])
    full = [k for k in range(_LEVELS) if np.sum(level == k) >= _MIN_IN_LEVEL]
    middles = 0.5 * (edges[1:] + edges[:-1])
    return [float(middles[k]) for k in full], [rms(error[level == k]) for k in full]


def _gains(axis: Any, board: BoardFit, names: list[str]) -> None:
    style(axis, "gains, one sigma")
    for number, part in enumerate(("sensor", "emitter")):
        factors = np.array([getattr(gains, part) for gains in board.fit.gains])
        sigma = np.array([np.hypot(gains.sigma, gains.common_sigma) for gains in board.fit.gains])
        places = np.arange(len(names))[:, None] + np.linspace(-0.15, 0.15, factors.shape[1])
        axis.errorbar(
            (places + (number - 0.5) * 0.36).ravel(),
            factors.ravel(),
            (np.ones_like(factors) * sigma[:, None] * factors).ravel(),
            fmt=".",
            markersize=3,
            linewidth=0.7,
            color=colour_of(number),
            label=f"{part}s",
        )
    axis.axhline(1.0, color=SOFT, linewidth=0.8, linestyle="--")
    axis.set_xticks(range(len(names)), names, rotation=90 if len(names) > 4 else 0)
    axis.legend(frameon=False, fontsize=9, ncols=2)


_CHI_SQUARE_99 = 11.345
_DEGREES = np.arange(0.0, 181.0, 2.0)
_MAX_POINTS = 4000


def board_text(board: BoardRecording, done: BoardCalibration, swarm: Swarm) -> str:
    """The parameters and errors of a calibrated board, one line each."""
    platform, held = done.model.platform, done.held_out
    law = platform.amplitudes[0]
    metres, bearing, heading = held.medians
    beyond = float(np.mean(held.nees > _CHI_SQUARE_99))
    names = [swarm.robots[index].name for index in board.robots]
    lines = [
        f"amplitude {law.scale:.4g} / (r + {law.offset:.4f})^{law.exponent:.3f} count",
        f"noise {platform.noise:.1f} count + {100.0 * platform.curve_sigma:.0f} % of the reading",
        f"blocked {100.0 * platform.blocked_share:.1f} %, too bright {100.0 * platform.bright_share:.1f} %",
        f"brightest reading by sensor [count]: {', '.join(f'{v:.0f}' for v in done.saturation)}",
        f"residuals of the platform to begin with {done.stock_sigma:.1f} sigma",
        f"{BLOCKS} blocks of time held out: {held.asked} exchanges, {100.0 * held.solved_share:.0f} % solved",
        f"medians {100.0 * metres:.2f} cm, {np.degrees(bearing):.1f} deg, {np.degrees(heading):.1f} deg",
        f"NEES median {np.median(held.nees):.2f}, {100.0 * beyond:.1f} % beyond the 99 % bound",
        f"covariances grown by {platform.covariance_scale:g}",
        f"gains of sensors are {'kept' if done.with_gains else 'not kept'}, by what they do there",
    ]
    lines += dead_lines(done.elements, names)
    turned = np.degrees(done.model.truth_yaw)
    lines.append("yaw ahead of ground truth [deg]: " + ", ".join(map("{} {:+.1f}".format, names, turned)))
    if done.curves_wrong:
        lines.append(
            "The curves of the platform to begin with are wrong here; no robot's gains were judged by them."
        )
    return "\n".join(lines)


def draw_board(board: BoardRecording, done: BoardCalibration, path: Path) -> Path:
    """Plot the curves of sensor and emitter before and after, with single readings."""
    figure = Figure(figsize=(11.0, 4.0))
    axes: list[Any] = list(figure.subplots(1, 2))
    for side, name in enumerate(("sensor", "emitter")):
        new, old = (_values(getattr(one, name)) for one in (done.model.platform, board.platform))
        style(axes[side], x=f"angle at the {name} [deg]")
        angles, values = _scatter(done, side, new)
        axes[side].plot(angles, values, ".", color=SOFT, markersize=2, alpha=0.3)
        axes[side].plot(_DEGREES, old, color=TRUTH, linestyle="--", label="before")
        axes[side].plot(_DEGREES, new, color=colour_of(side), label="fitted")
        axes[side].set_ylim(0.0, 2.0)
        axes[side].legend(frameon=False, fontsize=9)
    save(figure, path)
    return path


def _values(curve: AngleCurve) -> FloatArray:
    """Values of a curve at `_DEGREES`, relative to its value at zero."""
    table = curve.table()
    values = np.array([curve_at(table, angle)[0] for angle in np.radians(_DEGREES)])
    return np.asarray(values / values[0])


def _scatter(done: BoardCalibration, side: int, curve: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Angles [deg] and values of the curve according to single bright readings."""
    scatter, angles = done.model.scatter, np.degrees(done.model.angles[side])
    known = np.isfinite(scatter)
    step = max(1, int(known.sum()) // _MAX_POINTS)
    at, off = angles[known][::step], scatter[known][::step]
    return at, np.interp(at, _DEGREES, curve) * np.exp(
        done.model.platform.curve_sigma * np.clip(off, -4.0, 4.0)
    )
