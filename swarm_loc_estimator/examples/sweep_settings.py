"""Compare settings of the estimator over a bag, with a share of its messages lost: sweep_settings.py [BAG].

For many bags and settings use the command `sweep`: it runs replays in parallel and goes on where it stopped.
"""

import itertools
import math
import sys

from swarm_loc_estimator import Loss, Settings, load_swarm, replay

bag = sys.argv[1] if len(sys.argv) > 1 else "bags/eight_five_robots"
swarm = load_swarm(f"{bag}/swarm.yaml")

print("horizon [s]  lost  position [mm]  heading [deg]   NEES  too old")
for horizon_s, share in itertools.product((0.1, 2.0), (0.0, 0.5)):
    result = replay(bag, swarm, Settings(horizon_s=horizon_s), loss=Loss(share, seed=1))
    errors, too_old = result.overall, result.counters.get("too_old", 0)
    print(
        f"{horizon_s:11g} {share:5.0%} {1e3 * errors.position_rmse:14.2f}"
        f" {math.degrees(errors.heading_rmse):14.2f} {errors.nees:6.2f} {too_old:8}"
    )
