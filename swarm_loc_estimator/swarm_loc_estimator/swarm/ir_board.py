"""Infrared boards: arrangement, curves and errors of the elements, and their files, as in config/ir/*.yaml.

Sensor and emitter of the same number are side by side on a circle about the origin of base_link, both facing
outwards. There are at least three of each.
The curves S of sensors and E of emitters over an angle are data, either pieces of sums of powers, as the
Droplet paper prints (19) and (20), or a table. Both are sampled once into piecewise cubics with exact joints,
which are fast to evaluate and have the exact one-sided slopes at a kink.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy

from swarm_loc_estimator.common import codec
from swarm_loc_estimator.common.arrays import FloatArray
from swarm_loc_estimator.common.codec import EntrySpec, Tree, TreeChecks, entry, entry_specs, listed
from swarm_loc_estimator.common.parameters import NumberSpec, UserError, gate, number, number_specs, positive
from swarm_loc_estimator.common.yaml_tree import read_tree, write_tree

_CELLS = 128  # Number of cubics per piece; the error for the curves of the Droplet is 2e-6
_TABLE_CELLS = 720  # Number of cubics of a tabulated curve, which has no kinks: half a degree each
_JOINT = 0.01  # Maximum jump at a joint, relative to the curve's maximum; rounded printed joints have 1e-4


class IrPlatformError(ValueError):
    """An invalid platform; the message is one sentence with key and value."""


def check_numbers(holder: Any, prefix: str = "") -> None:
    """Raise IrPlatformError if a number of a dataclass is not in its declared range."""
    for name, spec in number_specs(type(holder)).items():
        value = getattr(holder, name)
        if not spec.allows(value):
            raise IrPlatformError(f"{prefix}{name} is {value:g} but must lie in {spec.range_text}.")


class CurveTable(NamedTuple):
    """A curve over [-pi, pi] in the form used by compiled code."""

    edges: FloatArray  # (P + 1,) boundaries of the pieces [rad]
    per_radian: FloatArray  # (P,) cells per radian of each piece
    cubics: FloatArray  # (P, cells, 4) coefficients of powers of t in [0, 1] across the cell, constant first

    @classmethod
    def of(cls, edges: FloatArray, cubics: FloatArray) -> CurveTable:
        """A table from the boundaries of pieces and their cubics."""
        return cls(edges, cubics.shape[1] / np.diff(edges), cubics)


@dataclass(frozen=True)
class PowerPiece:
    """A sum of powers of the absolute angle, up to a maximum."""

    below: float  # Start of the next piece [rad]; pi for the last
    terms: tuple[tuple[float, float], ...]  # Pairs (coefficient, exponent) of coefficient * |angle|^exponent


@dataclass(frozen=True)
class PowerCurve:
    """A symmetric curve in pieces, such as eqs (19) and (20) of the Droplet paper.

    Raises IrPlatformError if pieces do not ascend to pi, do not meet, or are not finite and positive.
    """

    pieces: tuple[PowerPiece, ...]

    def __post_init__(self) -> None:
        ends = [0.0, *(piece.below for piece in self.pieces)]
        if any(not low < high for low, high in itertools.pairwise(ends)) or ends[-1] != math.pi:
            raise IrPlatformError(f"pieces end at {ends[1:]} rad but must ascend from 0 to pi.")
        table = self.table()
        _check(table)
        highest = float(table.cubics[..., 0].max())
        for left, right in itertools.pairwise(self.pieces):
            before, after = (float(_powers(p.terms, np.array(left.below))[0]) for p in (left, right))
            if abs(before - after) > _JOINT * highest:
                values = f"where they are {before:.4g} and {after:.4g}"
                raise IrPlatformError(f"pieces do not meet at {left.below:g} rad, {values}.")

    def table(self) -> CurveTable:
        """The curve in the form used by compiled code."""
        edges = np.array([0.0, *(piece.below for piece in self.pieces)])
        half = [
            _cubics(*_powers(piece.terms, np.linspace(begin, piece.below, _CELLS + 1)), piece.below - begin)
            for begin, piece in zip(edges[:-1].tolist(), self.pieces, strict=True)
        ]
        mirror = [cubics[::-1] @ _BACKWARDS for cubics in half[::-1]]
        return CurveTable.of(np.concatenate([-edges[:0:-1], edges]), np.array([*mirror, *half]))


@dataclass(frozen=True)
class TabulatedCurve:
    """A curve given at angles, interpolated without overshoot; it need not be symmetric.

    Raises IrPlatformError if sizes do not fit, angles do not ascend, or values are not finite and positive.
    """

    # (K,) ascending within [-pi, pi] [rad]; the curve is constant beyond the first and last
    angles: tuple[float, ...] = field(metadata=entry(listed()))
    values: tuple[float, ...] = field(metadata=entry(listed()))  # (K,) not negative, at these angles [1]

    def __post_init__(self) -> None:
        if len(self.angles) < 2 or len(self.angles) != len(self.values):
            sizes = f"{len(self.angles)} angles and {len(self.values)} values"
            raise IrPlatformError(f"table has {sizes} but must have as many of both, at least two.")
        ascends = all(a < b for a, b in itertools.pairwise(self.angles))
        if not ascends or self.angles[0] < -math.pi or self.angles[-1] > math.pi:
            raise IrPlatformError(f"angles are {list(self.angles)} but must ascend within [-pi, pi] rad.")
        _check(self.table())

    def table(self) -> CurveTable:
        """The curve in the form used by compiled code."""
        curve = scipy.interpolate.PchipInterpolator(self.angles, self.values)
        at = np.linspace(-math.pi, math.pi, _TABLE_CELLS + 1)
        within = np.clip(at, self.angles[0], self.angles[-1])
        slopes = np.where(at == within, curve.derivative()(within), 0.0)
        return CurveTable.of(at[[0, -1]], _cubics(curve(within), slopes, 2.0 * math.pi)[None])


AngleCurve = PowerCurve | TabulatedCurve
_BELOW = NumberSpec("rad", 0.0, math.pi, True, "where the next piece begins")


def _read_curve(checks: TreeChecks, tree: Tree, key: str) -> AngleCurve:
    """S or E, as pieces or as a table."""
    table = entry_specs(TabulatedCurve)
    keys = checks.mapping(tree, key, ("pieces", *table))
    if "pieces" not in keys:
        return checks.made(f"{key}.", TabulatedCurve, **checks.values(tree, key, table, table))
    checks.mapping(tree, key, ("pieces",))
    pieces = checks.items(keys["pieces"], f"{key}.pieces") or [None]
    read = []
    for k, one in enumerate(pieces):
        here, is_last = f"{key}.pieces[{k}]", k == len(pieces) - 1
        known = ("terms",) if is_last else ("below", "terms")  # the last one ends at pi
        piece, terms = checks.mapping(one, here, known, known), []
        for number_of_term, item in enumerate(checks.items(piece["terms"], f"{here}.terms")):
            place = f"{here}.terms[{number_of_term}]"
            term = checks.list_of_numbers(item, place)
            if len(term) != 2:
                raise checks.error(place, item, "must be [coefficient, exponent]")
            terms.append((term[0], term[1]))
        below = math.pi if is_last else checks.number(piece["below"], f"{here}.below", _BELOW)
        read.append(PowerPiece(below or 0.0, tuple(terms)))
    return checks.made(f"{key}.", PowerCurve, pieces=tuple(read))


_CURVE = EntrySpec(_read_curve, {})


@dataclass(frozen=True)
class Amplitude:
    """Brightness of an aligned pair at a distance r: scale / (r + offset)^exponent + background.

    Eq. (21) of the Droplet paper has a pole at 3 cm and is invalid at shorter distances. Below `nearest` the
    curve is extrapolated along its tangent, which keeps it finite and monotonic.
    """

    scale: float = positive(1.4, "count m^exponent", 1e9, "brightness at a distance of 1 m")
    offset: float = number(0.0, "m", -1.0, 1.0, "added to the distance")
    exponent: float = positive(2.0, "1", 10.0, "how fast brightness falls")
    background: float = number(0.0, "count", -1e6, 1e6, "added to every reading before S and E")
    nearest: float = number(0.0, "m", 0.0, 1.0, "closest distance of the law, nearer it is linear")

    def __post_init__(self) -> None:
        check_numbers(self)
        if self.nearest + self.offset <= 0.0:
            rule = f"must be beyond the pole at {-self.offset:g} m"
            raise IrPlatformError(f"nearest is {self.nearest:g} m but {rule}.")


def _powers(terms: tuple[tuple[float, float], ...], size: FloatArray) -> tuple[FloatArray, FloatArray]:
    with np.errstate(divide="ignore", invalid="ignore"):
        value = sum((c * size**e for c, e in terms), np.zeros_like(size))
        slope = sum((c * e * size ** (e - 1.0) for c, e in terms if e != 0.0), np.zeros_like(size))
    return value, slope


_BACKWARDS = np.array([[1.0, 0, 0, 0], [1.0, -1, 0, 0], [1.0, -2, 1, 0], [1.0, -3, 3, -1]])
"""Right factor that converts coefficients of powers of t into those of powers of 1 - t."""


def _cubics(values: FloatArray, slopes: FloatArray, length: float) -> FloatArray:
    """(cells, 4) cubics through equidistant values with these slopes."""
    if not (np.isfinite(values).all() and np.isfinite(slopes).all()):
        raise IrPlatformError("curve is not finite everywhere within [-pi, pi] rad.")
    width = length / (len(values) - 1)
    v0, v1, s0, s1 = values[:-1], values[1:], width * slopes[:-1], width * slopes[1:]
    return np.stack([v0, s0, 3.0 * (v1 - v0) - 2.0 * s0 - s1, 2.0 * (v0 - v1) + s0 + s1], axis=-1)


def _check(table: CurveTable) -> None:
    """Check that a curve is nowhere negative and not zero everywhere."""
    values = table.cubics[..., 0]
    if values.min() < 0.0:
        raise IrPlatformError(f"curve falls to {values.min():.4g} but must not be negative.")
    if values.max() <= 0.0:
        raise IrPlatformError("curve is zero everywhere.")


POWERS = ("far", "near")  # Of emitters, in the order of BrightnessMatrix's POWER_*; the second is optional
MAX_ELEMENTS = 32
GAIN_LISTS = ("sensor", "emitter")
GAIN_RANGE = (0.05, 20.0)
_GAINS = listed(minimum=GAIN_RANGE[0], maximum=GAIN_RANGE[1])
_TOGETHER = 1e-3  # Minimum angle between two elements [rad]


class ReadingErrors(NamedTuple):
    """Error model of readings; a separate tuple, because passing a whole model per reading is slow."""

    noise: float  # Standard deviation of a reading [count]
    relative: float  # Additional standard deviation relative to the expected reading [1]
    systematic: float  # Share of the relative variance that is systematic
    blocked: float  # Maximum cost of a reading that may be blocked; infinite: never blocked
    bright: float  # Maximum cost of a reading that may be too bright


class IrModel(NamedTuple):
    """A platform for compiled code."""

    radius: float  # Distance from the centre to the elements [m]
    angles: FloatArray  # (n,) directions of the elements in base_link [rad]
    units: FloatArray  # (n, 2) their unit vectors
    sensor: CurveTable  # The curve S
    emitter: CurveTable  # The curve E
    amplitudes: FloatArray  # (modes, 5) the fields of `Amplitude`
    saturation: float  # Readings at or above are only lower bounds [count]
    noise: float  # Standard deviation of a reading [count]
    errors: ReadingErrors  # Error model of readings
    stray: float  # Additional noise, relative to the brightest reading of an exchange
    scale: float  # Factor on covariances


@dataclass(frozen=True)
class IrPlatform:
    """An infrared board.

    Raises IrPlatformError if a number is out of range, elements coincide, or dark_level reaches saturation.
    """

    # (n,) directions of the elements in base_link [rad], counter-clockwise positive
    angles: tuple[float, ...] = field(metadata=entry(listed()))
    sensor: AngleCurve = field(metadata=entry(_CURVE))  # S, sensor reading over the angle of incidence
    emitter: AngleCurve = field(metadata=entry(_CURVE))  # E, light over the angle to the emitter's axis
    amplitudes: tuple[Amplitude, ...]  # A for each power of the emitters, in the order of `POWERS`
    radius: float = positive(0.022, "m", 10.0, "from the centre to the elements")
    saturation: float = positive(255.0, "count", 1e9, "readings from here on are lower bounds")
    dark_level: float = number(0.0, "count", -1e6, 1e6, "mean reading without light")
    noise: float = positive(1.0, "count", 1e6, "standard deviation of every reading")
    relative_noise: float = number(0.0, "1", 0.0, 1.0, "additional noise, relative to the reading")
    stray_noise: float = number(0.0, "1", 0.0, 1.0, "noise of reflections, relative to the brightest reading")
    curve_sigma: float = number(0.0, "1", 0.0, 1.0, "relative systematic error of the curves, one sigma")
    blocked_share: float = number(0.02, "1", 0.0, 0.5, "share of readings darkened by an obstacle; 0: none")
    bright_share: float = number(0.0, "1", 0.0, 0.5, "share of readings with foreign light; 0: none")
    covariance_scale: float = number(1.0, "1", 1.0, 1e3, "factor on covariances, for errors with long tails")
    element_sigma: float = number(0.1, "1", 0.0, 1.0, "relative standard deviation of gains; 0: all equal")

    def __post_init__(self) -> None:
        check_numbers(self)
        if not 3 <= self.n <= MAX_ELEMENTS:
            raise IrPlatformError(f"angles has {self.n} elements but must have 3 to {MAX_ELEMENTS}.")
        if not all(math.isfinite(angle) and abs(angle) <= 2.0 * math.pi for angle in self.angles):
            raise IrPlatformError(f"angles is {list(self.angles)} but must lie within [-2 pi, 2 pi] rad.")
        ahead = np.sort(np.mod(self.angles, 2.0 * math.pi))
        if np.min(np.diff(ahead, append=ahead[0] + 2.0 * math.pi)) < _TOGETHER:
            raise IrPlatformError(f"angles is {list(self.angles)} but no two elements may coincide.")
        if self.dark_level >= self.saturation:
            rule = f"must be below saturation, {self.saturation:g}"
            raise IrPlatformError(f"dark_level is {self.dark_level:g} count but {rule}.")
        if not 1 <= len(self.amplitudes) <= len(POWERS):
            raise IrPlatformError(f"amplitudes has {len(self.amplitudes)} powers but must have one or two.")

    @property
    def n(self) -> int:
        """Number of sensors, and of emitters."""
        return len(self.angles)

    @property
    def powers(self) -> tuple[str, ...]:
        """Names of its powers, in the order of the first axis of readings."""
        return POWERS[: len(self.amplitudes)]

    @property
    def relative(self) -> float:
        """Relative standard deviation of readings, in addition to `noise`."""
        return math.hypot(self.relative_noise, self.curve_sigma)

    @cached_property
    def model(self) -> IrModel:
        """The platform for compiled code."""
        angles = np.array(self.angles)
        units = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        laws = np.array([[getattr(law, name) for name in number_specs(Amplitude)] for law in self.amplitudes])
        systematic = (self.curve_sigma / self.relative) ** 2 if self.relative else 0.0
        shares = (self.blocked_share, self.bright_share)
        costs = (-math.log(share) if share else math.inf for share in shares)
        errors = ReadingErrors(self.noise, self.relative, systematic, *costs)
        return IrModel(
            *(self.radius, angles, units, self.sensor.table(), self.emitter.table(), laws),
            *(self.saturation, self.noise, errors, self.stray_noise, self.covariance_scale),
        )

    def unknown_gains(self, count: int) -> PairGains:
        """Gains of pairs of robots that were never calibrated."""
        sigma = np.zeros((count, 4))
        sigma[:, ::2] = self.element_sigma
        ones = np.ones((count, self.n))
        return PairGains(ones, ones, sigma)


@dataclass(frozen=True)
class IrGains:
    """Gains of one robot's elements relative to its platform.

    Raises IrPlatformError if a factor is not in [0.05, 20], sizes differ, or an element does not exist.
    """

    sensor: tuple[float, ...] = field(metadata=entry(_GAINS))  # (n,) factors of the sensors [1]
    emitter: tuple[float, ...] = field(metadata=entry(_GAINS))  # (n,) factors of the emitters [1]
    sigma: float = number(0.0, "1", 0.0, 1.0, "how unsure each factor still is, relative, by itself")
    common_sigma: float = number(0.0, "1", 0.0, 1.0, "how unsure all of a robot's factors are together")
    dead_sensors: tuple[int, ...] = ()  # Numbers of sensors to ignore
    dead_emitters: tuple[int, ...] = ()  # Numbers of emitters to ignore

    def __post_init__(self) -> None:
        count, (low, high) = len(self.sensor), GAIN_RANGE
        if count != len(self.emitter):
            sizes = f"{count} sensors and {len(self.emitter)} emitters"
            raise IrPlatformError(f"gains have {sizes} but must have as many of both.")
        for name in GAIN_LISTS:
            if wild := [value for value in getattr(self, name) if not low <= value <= high]:
                rule = f"factors must lie in [{low:g}, {high:g}]"
                raise IrPlatformError(f"gains.{name} has {wild[0]:g} but {rule}.")
        for name in ("dead_sensors", "dead_emitters"):
            if wrong := [k for k in getattr(self, name) if not 0 <= k < count]:
                raise IrPlatformError(f"{name} has {wrong[0]} but elements are numbered 0 to {count - 1}.")
        check_numbers(self, "gains.")

    @classmethod
    def unknown(cls, platform: IrPlatform) -> IrGains:
        """Gains of a robot that was never calibrated."""
        ones = (1.0,) * platform.n
        return cls(ones, ones, platform.element_sigma)


class PairGains(NamedTuple):
    """Gains of k pairs of robots, for the models."""

    sensor: FloatArray  # (k, n) gains of each receiver's sensors; NaN: dead
    emitter: FloatArray  # (k, n) gains of each transmitter's emitters; NaN: dead
    sigma: FloatArray  # (k, 4) individual and common sigma of the receiver's sensors, then of the emitters

    @classmethod
    def of(cls, receivers: list[IrGains], transmitters: list[IrGains]) -> PairGains:
        """Gains of pairs of a receiver and a transmitter."""
        pairs = list(zip(receivers, transmitters, strict=True))
        sensor, emitter = np.array([r.sensor for r, _ in pairs]), np.array([t.emitter for _, t in pairs])
        for k, (receiver, transmitter) in enumerate(pairs):
            sensor[k, list(receiver.dead_sensors)] = np.nan
            emitter[k, list(transmitter.dead_emitters)] = np.nan
        sigmas = [(r.sigma, r.common_sigma, t.sigma, t.common_sigma) for r, t in pairs]
        return cls(sensor, emitter, np.array(sigmas))


def _elements(doc: str) -> EntrySpec:
    def read(checks: TreeChecks, value: Tree, key: str) -> tuple[int, ...]:
        numbers = checks.list_of_numbers(value, key)
        if any(number != int(number) or number < 0 for number in numbers):
            raise checks.error(key, value, "must be a list of numbers of elements, from 0 on")
        return tuple(int(number) for number in numbers)

    return EntrySpec(read, {"type": "array", "items": {"type": "integer", "minimum": 0}, "description": doc})


def _read_gains(checks: TreeChecks, tree: Tree, key: str) -> IrGains | None:
    """Factors of all elements; null: never calibrated."""
    if tree is None:
        return None
    values = checks.values(tree, key, entry_specs(IrGains), GAIN_LISTS)
    return checks.made(key.removesuffix("gains"), IrGains, **values)


FOLDER = Path(__file__).parents[1] / "config" / "ir"
PACKAGED = tuple(sorted(path.stem for path in FOLDER.glob("*.yaml")))  # Names of platforms
_PLATFORM = "the name of a packaged one or the path of a file"
_SAID = {"description": f"one of {', '.join(PACKAGED)}, or the path of a file"}
_SOURCE = codec.matching(".*", _PLATFORM, _SAID, _PLATFORM)
_GAINS_SCHEMA = {
    "description": "factors of the elements",
    "type": ["object", "null"],
    "additionalProperties": False,
    "properties": codec.properties(entry_specs(IrGains), IrGains),
    "required": list(GAIN_LISTS),
}


@dataclass(frozen=True)
class RobotIr:
    """The infrared board of one robot."""

    #: Id in its exchanges, 1 to 65535, unique in the swarm
    id: int = field(metadata=entry(codec.address(2**16 - 1, "id in exchanges")))
    #: Model of the board
    platform: IrPlatform = field(metadata=entry(_SOURCE))
    source: str  #: Name of a packaged platform, or absolute path of its file
    #: Calibrated gains of its elements; None: never calibrated
    gains: IrGains | None = field(default=None, metadata=entry(EntrySpec(_read_gains, _GAINS_SCHEMA)))
    #: Numbers of sensors to ignore
    dead_sensors: tuple[int, ...] = field(default=(), metadata=entry(_elements("sensors to ignore")))
    #: Numbers of emitters to ignore
    dead_emitters: tuple[int, ...] = field(default=(), metadata=entry(_elements("emitters to ignore")))
    gate_probability: float = gate("measurements")

    @property
    def believed_gains(self) -> IrGains:
        """Gains of the description, or unknown gains, with the dead elements."""
        gains = self.gains or IrGains.unknown(self.platform)
        return replace(gains, dead_sensors=self.dead_sensors, dead_emitters=self.dead_emitters)


FILE_VERSION = 1
_KEYS = ("fileversion", "powers")  # Of a file, in addition to the entries of `IrPlatform`


class IrPlatformFileError(UserError):
    """An invalid platform file; the message is one sentence with file, key and value."""


def load_ir_platform(name: str) -> IrPlatform:
    """Read and check a packaged platform, such as "droplet", or that of a file, whose path ends in .yaml.

    Raises IrPlatformFileError with file, key, value and what is allowed.
    """
    path = Path(name)
    if not name.endswith((".yaml", ".yml")):
        path = FOLDER / f"{name}.yaml"
        if name not in PACKAGED:
            packaged = f"packaged infrared platform ({', '.join(PACKAGED)})"
            raise IrPlatformFileError(f"{codec.shown(name)} is no {packaged} and no path of a .yaml file.")
    checks, specs = TreeChecks(path, IrPlatformFileError), entry_specs(IrPlatform)
    tree = read_tree(path, IrPlatformFileError)
    keys = checks.mapping(tree, codec.WHOLE_FILE, (*_KEYS, *specs), (*_KEYS, "angles", *GAIN_LISTS))
    checks.version(keys["fileversion"], FILE_VERSION)
    values = checks.values(keys, codec.WHOLE_FILE, specs, others=_KEYS)
    powers, specs = checks.mapping(keys["powers"], "powers", POWERS, POWERS[:1]), entry_specs(Amplitude)
    values["amplitudes"] = tuple(
        checks.made(f"{key}.", Amplitude, **checks.values(powers[power], key, specs, ("scale",)))
        for power in POWERS[: len(powers)]
        for key in [f"powers.{power}"]
    )
    return checks.made("", IrPlatform, **values)


def save_ir_platform(platform: IrPlatform, path: Path, comment: str = "") -> None:
    """Write a board, which `load_ir_platform` reads back equal, with lines of comment at its top."""
    laws = dict(zip(platform.powers, platform.amplitudes, strict=True))
    tree: dict[str, Tree] = {"fileversion": FILE_VERSION, "angles": list(platform.angles)}
    for name in GAIN_LISTS:
        curve: AngleCurve = getattr(platform, name)
        if isinstance(curve, TabulatedCurve):
            tree[name] = codec.to_tree(curve)
        else:
            below = [{"below": piece.below} for piece in curve.pieces[:-1]]
            terms = [{"terms": [list(term) for term in piece.terms]} for piece in curve.pieces]
            tree[name] = {"pieces": [{**a, **b} for a, b in zip([*below, {}], terms, strict=True)]}
    tree["powers"] = {name: codec.to_tree(law, keep=entry_specs(Amplitude)) for name, law in laws.items()}
    tree |= codec.to_tree(platform, keep=entry_specs(IrPlatform), without=("angles", *GAIN_LISTS))
    write_tree(tree, path, comment.splitlines())
