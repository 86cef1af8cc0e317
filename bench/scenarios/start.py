"""The command of this folder as those of the packages; `bench.robustness` finds it by its name."""

from __future__ import annotations

from swarm_loc_estimator.common.command_line import Program

generate_bag = Program("bench.scenarios.generate_bag")
