"""Success rates with their confidence intervals, and times."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

SWARMS = (2, 5, 10, 20, 50)  # Sizes of swarms for which everything is measured
_NORMAL_95 = 1.959964


class Rate(NamedTuple):
    """A share of trials."""

    successes: int  # How many
    trials: int  # Of how many

    @property
    def share(self) -> float:
        """Of successes."""
        return self.successes / self.trials

    @property
    def interval(self) -> tuple[float, float]:
        """That of 95 % confidence, after Wilson (1927)."""
        squared = _NORMAL_95**2
        middle = (self.successes + 0.5 * squared) / (self.trials + squared)
        variance = self.share * (1.0 - self.share) * self.trials + 0.25 * squared
        half = _NORMAL_95 * math.sqrt(variance) / (self.trials + squared)
        return max(0.0, middle - half), min(1.0, middle + half)


@dataclass
class Results:
    """What was measured."""

    rates: dict[str, Rate] = field(default_factory=dict)  # By the name of the figure
    values: dict[str, float] = field(default_factory=dict)  # Other figures by name

    def count(self, name: str, successes: int, trials: int) -> None:
        """Note a success rate, and tell of it."""
        self.rates[name] = rate = Rate(successes, trials)
        low, high = rate.interval
        print(f"{name}: {100.0 * rate.share:.1f} % ({100.0 * low:.1f} - {100.0 * high:.1f})", flush=True)

    def figures(self) -> dict[str, float]:
        """All figures, flat; rates with the ends of their intervals."""
        out = dict(self.values)
        for name, rate in self.rates.items():
            out[name] = rate.share
            out[f"{name}_low"], out[f"{name}_high"] = rate.interval
        return out
