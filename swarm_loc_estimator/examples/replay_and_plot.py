"""Replay a bag, print the errors of each robot and draw paths and errors: replay_and_plot.py [BAG] [PICTURE].

The bag needs ground truth: `<robot>/ground_truth`, or files in the format of TUM, see `read_truth`.
"""

import math
import sys

from matplotlib.figure import Figure

from swarm_loc_estimator import replay

bag = sys.argv[1] if len(sys.argv) > 1 else "bags/eight_five_robots"
picture = sys.argv[2] if len(sys.argv) > 2 else "paths_and_errors.png"
result = replay(bag)

print(f"{'robot':10} position [m]  heading [deg]   NEES")
for name, errors in (*result.summaries.items(), ("all", result.overall)):
    heading_deg = math.degrees(errors.heading_rmse)
    print(f"{name:10} {errors.position_rmse:12.4f} {heading_deg:14.2f} {errors.nees:6.2f}")

figure = Figure(figsize=(11.0, 5.0), layout="constrained")
paths, distances = figure.subplots(1, 2)
for k, robot in enumerate(result.swarm.robots):
    if robot.name not in result.truth:
        continue
    truth, errors_of_robot = result.truth[robot.name], result.errors[robot.name]
    paths.plot(*truth.pose[:, :2].T, color="0.7", linewidth=3.0)
    paths.plot(*result.poses[:, k, :2].T, color=f"C{k}", linewidth=1.0, label=robot.name)
    seconds = 1e-9 * (errors_of_robot.stamp_ns - result.stamp_ns[0])
    distances.plot(seconds, 100.0 * errors_of_robot.position, color=f"C{k}", label=robot.name)
paths.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title="estimated paths, ground truth in grey")
distances.set(xlabel="time [s]", ylabel="position error [cm]", title="errors")
distances.legend()
figure.savefig(picture, dpi=150)
print(f"picture: {picture}")
