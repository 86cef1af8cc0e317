"""Parameters of the Droplets' driver nodes, and what follows from them."""

from __future__ import annotations

import re
from dataclasses import dataclass

from swarm_loc_drivers.common.robot_driver import DriverParameters
from swarm_loc_drivers.droplet.exchange import MIN_TURN_S, PollingSettings, SessionSettings, TdmaSettings
from swarm_loc_drivers.droplet.hardware import DROPLET_MODELS, ELEMENTS, FULL_POWER
from swarm_loc_estimator.common.parameters import ParameterError, choice, number, text, texts

_ID = re.compile(r"(?:0[xX])?([0-9A-Fa-f]{1,4})")
_RELAYED = re.compile(r"([A-Za-z]\w*)=(.*)")


@dataclass(frozen=True)
class DropletTraits(DriverParameters):
    """Parameters that all Droplets of a table share."""

    model: str = choice(
        "droplet", tuple(DROPLET_MODELS), "an audio_droplet moves only ahead, back and in turns"
    )
    reply_timeout_s: float = number(0.3, "s", 0.01, 10.0, "how long an echo or an answer may take")
    stride_s: float = number(
        2.0, "s", 0.2, 60.0, "duration of a commanded motion, which continues for so long if the driver dies"
    )
    odom_rate: float = number(5.0, "1/s", 0.1, 20.0, "published odometry")
    walk_noise: float = number(5e-4, "m", 0.0, 1.0, "variance along and across of a walk per metre [m^2/m]")
    veer_noise: float = number(0.05, "rad^2/m", 0.0, 100.0, "variance of the heading per metre walked")
    turn_noise: float = number(0.01, "rad", 0.0, 10.0, "variance of the heading per radian turned")
    far_power: int = number(FULL_POWER, "1", 1, FULL_POWER, "power of the emitters in far exchanges")
    near_power: int = number(40, "1", 0, FULL_POWER - 1, "power in near exchanges; 0: only far ones")
    saturation: int = number(240, "count", 1, 4095, "readings saturate here: full scale less ambient light")
    turn_s: float = number(1.0, "s", MIN_TURN_S, 60.0, "how long a turn to emit lasts")


@dataclass(frozen=True)
class DropletParameters(DropletTraits):
    """Parameters of `droplet_driver_node`.

    Raises ParameterError if a parameter is invalid, or conflicts with another one.
    """

    address: str = text("", "the serial port of the Droplet at the cable", required=True)
    partners: tuple[str, ...] = texts("ids of the Droplets to measure, in hexadecimal as they print them")
    exchange_rate: float = number(
        0.5, "1/s", 0.0, 2.0, "exchanges in which a partner is asked to emit; 0: only on request"
    )
    retries: int = number(5, "1", 0, 100, "how often a partner is asked again when no matrix arrives")
    least_brightness: int = number(
        5, "count", 0, 4095, "a far matrix without a brighter reading shows no robot and is requested again"
    )
    turns: int = number(
        0, "1", 0, 10_000, "with a cable at every Droplet: how many take turns to emit; 0: partners are asked"
    )
    turn: int = number(0, "1", 0, 9_999, "which turn is this one's, counted from 0")
    relayed: tuple[str, ...] = texts(
        "NAME=ID of Droplets without a cable, which are driven by infrared through this one"
    )
    relay_loss: float = number(0.1, "1", 0.0, 1.0, "share of commands by infrared that are lost")

    def __post_init__(self) -> None:
        if not self.address.startswith("/"):
            raise ParameterError(
                f"parameter address = '{self.address}' must be the path of a serial port,"
                " such as /dev/ttyUSB0."
            )
        _ = self.session, self.relayed_ids

    @property
    def session(self) -> SessionSettings:
        """Settings of the session."""
        partners: list[int] = []
        for one in self.partners:
            robot = _id("partners", one)
            if robot in partners:
                raise ParameterError(f"parameter partners has '{one}', but each id may stand once.")
            partners.append(robot)
        far, near = self.far_power, self.near_power
        if near >= far:
            raise ParameterError(f"parameter near_power = {near} must be below far_power = {far}.")
        powers, known = (far, near) if near else (far,), tuple(partners)
        exchanges: PollingSettings | TdmaSettings
        if self.turns:
            if self.turn >= self.turns:
                raise ParameterError(f"parameter turn = {self.turn} must be below turns = {self.turns}.")
            exchanges = TdmaSettings(self.turn, self.turns, self.turn_s, powers, known)
        else:
            period_s = 1.0 / self.exchange_rate if self.exchange_rate else 0.0
            exchanges = PollingSettings(known, period_s, self.retries, powers, self.least_brightness)
        return SessionSettings(DROPLET_MODELS[self.model], ELEMENTS, self.reply_timeout_s, exchanges)

    @property
    def relayed_ids(self) -> dict[str, int]:
        """Names and ids of the robots without a cable."""
        found: dict[str, int] = {}
        for one in self.relayed:
            match = _RELAYED.fullmatch(one)
            if match is None:
                raise ParameterError(f"parameter relayed has '{one}' but must have entries as droplet2=6B6F.")
            name, robot = match[1], _id("relayed", match[2])
            if name in found or robot in found.values():
                raise ParameterError(
                    f"parameter relayed has '{one}', but each name and each id may stand once."
                )
            found[name] = robot
        return found


@dataclass(frozen=True)
class DropletFleetParameters(DropletTraits):
    """Parameters of `droplet_fleet_node`."""

    swarm_file: str = text("", "path of the swarm description: which robots there are", required=True)
    link_folder: str = text("", "where each robot's serial port lies under its name", required=True)
    part: int = number(0, "1", 0, 999, "of the table's parts, each in a process of its own, this one")
    parts: int = number(1, "1", 1, 1000, "how many parts there are")


def _id(parameter: str, value: str) -> int:
    """A Droplet's id."""
    match = _ID.fullmatch(value)
    if match is None or not int(match[1], 16):
        raise ParameterError(f"parameter {parameter} has the id '{value}' but ids lie in [1, FFFF].")
    return int(match[1], 16)
