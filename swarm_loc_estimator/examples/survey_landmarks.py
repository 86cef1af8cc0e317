"""Find the places of landmarks in a recording, as the command `survey` does: survey_landmarks.py [BAG].

The landmarks of swarm.yaml are taken out first; what was measured by hand is only compared.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from swarm_loc_estimator import load_swarm
from swarm_loc_estimator.offline.calibration.recording import read_recording
from swarm_loc_estimator.offline.survey.survey import survey

bag = Path(sys.argv[1] if len(sys.argv) > 1 else "bags/eight_five_robots")
described = load_swarm(bag / "swarm.yaml")
unknown = replace(described, landmarks=())  # the starts of the robots give the frame
found = survey(read_recording(bag, unknown), unknown).swarm

print("   id    x [m]    y [m]   sigma [m]   from swarm.yaml [m]")
places, away = {one.id: one for one in described.landmarks}, []
shared = found.map_error  # what all places have in common: the frame is as good as the starts
for mark in found.landmarks:
    known = places[mark.id]
    away.append(np.hypot(mark.x - known.x, mark.y - known.y))
    turned = np.hypot(shared.yaw_sigma, shared.scale_sigma) * np.hypot(mark.x - shared.x, mark.y - shared.y)
    sigma = np.sqrt(mark.position_sigma**2 + shared.position_sigma**2 + 0.5 * turned**2)  # of x and y
    print(f"{mark.id:5} {mark.x:8.3f} {mark.y:8.3f} {sigma:11.4f} {away[-1]:12.4f}")
print(f"{len(away)} of {len(places)} landmarks, RMS {np.sqrt(np.mean(np.square(away))):.4f} m")
