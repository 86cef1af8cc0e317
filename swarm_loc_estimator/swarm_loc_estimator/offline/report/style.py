"""Plot style of all reports: colours, axes, units, file format."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

if TYPE_CHECKING:
    from pathlib import Path

    import numpy.typing as npt
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, SOFT, TRUTH = "#22303c", "#6b7a86", "#9aa5b1"
# Okabe and Ito: told apart by everyone
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
_DPI = 120
_PAD_IN = 0.08
_PALETTE = 256
"""So many colours make the file half as large as all of them."""
_MILLIMETRES_BELOW_M = 0.1
_MIN_GAP_NS = 2_000_000_000


def colour_of(index: int) -> str:
    """The colour of a robot in all pictures."""
    return _COLOURS[index % len(_COLOURS)]


def length_unit(length: float) -> tuple[float, str]:
    """The unit that a length [m] is best told in: how many of it are a metre, and its name."""
    return (1e3, "mm") if abs(length) < _MILLIMETRES_BELOW_M else (1.0, "m")


def length_text(length: float) -> str:
    """A length [m] in the unit that it is best told in."""
    metre, unit = length_unit(length)
    return f"{metre * length:.{1 if unit == 'mm' else 2}f} {unit}"


def seconds_since(begin_ns: int, stamp_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    """The axis of time [s]."""
    return (stamp_ns - begin_ns).astype(np.float64) * 1e-9


def style(axis: Axes) -> None:
    """Quiet axes: the data speak."""
    axis.grid(visible=True, color="#e4e8ec", linewidth=0.6)
    axis.set_axisbelow(True)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axis.spines[side].set_color("#c3ccd4")
    axis.tick_params(colors=SOFT, labelsize=8, length=3)


def broken(stamp_ns: npt.NDArray[np.int64], rows: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Rows with one of NaN in each gap of time, so that no line is drawn across what is not known."""
    step_ns = np.diff(stamp_ns)
    if len(step_ns) == 0:
        return rows
    gaps = np.flatnonzero(step_ns > max(_MIN_GAP_NS, 5 * int(np.median(step_ns)))) + 1
    return np.insert(rows, gaps, np.nan, axis=0)


def save(figure: Figure, path: Path) -> None:
    """Write a picture with few colours and without a stamp of version or time: equal results, equal files."""
    figure.set_layout_engine("constrained", w_pad=_PAD_IN, h_pad=_PAD_IN)
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=_DPI, format="png")
    Image.open(drawn).convert("RGB").quantize(_PALETTE).save(path, format="png", optimize=True)
