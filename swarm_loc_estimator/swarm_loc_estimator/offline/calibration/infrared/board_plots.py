"""Text and picture of a board's calibration: curves beside those it began with, errors held out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.infrared.curves import AngleCurve, curve_at
from swarm_loc_estimator.offline.calibration.infrared.board import BLOCKS, BoardCalibration
from swarm_loc_estimator.offline.calibration.infrared.board_recording import BoardRecording
from swarm_loc_estimator.offline.calibration.infrared.plots import dead_lines
from swarm_loc_estimator.offline.report.style import SOFT, TRUTH, colour_of, save, style
from swarm_loc_estimator.swarm.swarm import Swarm

_CHI_SQUARE_99 = 11.345
_DEGREES = np.arange(0.0, 181.0, 2.0)
_MAX_POINTS = 4000


def board_text(board: BoardRecording, done: BoardCalibration, swarm: Swarm) -> str:
    """What was found, a line each."""
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
    """Curves of sensor and emitter beside those of before, with the residuals' scatter about them."""
    figure = Figure(figsize=(11.0, 4.0))
    axes: list[Any] = list(figure.subplots(1, 2))
    for side, name in enumerate(("sensor", "emitter")):
        new, old = (_values(getattr(one, name)) for one in (done.model.platform, board.platform))
        style(axes[side])
        angles, values = _scatter(done, side, new)
        axes[side].plot(angles, values, ".", color=SOFT, markersize=2, alpha=0.3)
        axes[side].plot(_DEGREES, old, color=TRUTH, linestyle="--", label="before")
        axes[side].plot(_DEGREES, new, color=colour_of(side), label="fitted")
        axes[side].set_ylim(0.0, 2.0)
        axes[side].set_xlabel(f"angle at the {name} [deg]", color=SOFT, fontsize=9)
        axes[side].legend(frameon=False, fontsize=9)
    save(figure, path)
    return path


def _values(curve: AngleCurve) -> FloatArray:
    """At `_DEGREES`, relative to straight ahead."""
    table = curve.table()
    values = np.array([curve_at(table, angle)[0] for angle in np.radians(_DEGREES)])
    return np.asarray(values / values[0])


def _scatter(done: BoardCalibration, side: int, curve: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Angles [deg] and what the curve would be by single readings where light is bright."""
    scatter, angles = done.model.scatter, np.degrees(done.model.angles[side])
    known = np.isfinite(scatter)
    step = max(1, int(known.sum()) // _MAX_POINTS)
    at, off = angles[known][::step], scatter[known][::step]
    return at, np.interp(at, _DEGREES, curve) * np.exp(
        done.model.platform.curve_sigma * np.clip(off, -4.0, 4.0)
    )
