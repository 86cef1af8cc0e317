"""Replay a bag and print the errors of each robot against ground truth: replay_errors.py [BAG]."""

import math
import sys

from swarm_loc_estimator import replay

result = replay(sys.argv[1] if len(sys.argv) > 1 else "bags/eight_five_robots")

print(f"{'robot':10} position [m]  heading [deg]   NEES")
for name, errors in (*result.summaries.items(), ("all", result.overall)):
    heading_deg = math.degrees(errors.heading_rmse)
    print(f"{name:10} {errors.position_rmse:12.4f} {heading_deg:14.2f} {errors.nees:6.2f}")
