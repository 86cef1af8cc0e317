"""Frequencies of LEDs as users write them."""

from __future__ import annotations

from collections.abc import Collection

from swarm_loc_estimator.common.parameters import ParameterError


def led_frequencies(entries: Collection[str], robots: Collection[str]) -> dict[str, float]:
    """Robot -> frequency of its LEDs [Hz].

    Raises:
        ParameterError: An entry is not a robot's name, '=' and a number above 0.
    """
    found: dict[str, float] = {}
    for entry in entries:
        name, _, value = entry.partition("=")
        try:
            frequency = float(value)
        except ValueError:
            frequency = 0.0
        if name not in robots or not 0.0 < frequency < 1e6:
            raise ParameterError(
                f"parameter led_frequencies: '{entry}' must be the name of a robot that maps, '=' and a"
                " frequency in (0, 1e6) Hz."
            )
        found[name] = frequency
    return found
