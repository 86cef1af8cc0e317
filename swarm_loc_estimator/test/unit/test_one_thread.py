"""The estimator reckons in one thread, whatever the machine offers."""

import os
import subprocess
import sys

RECKON = """
import os
import swarm_loc_estimator.filter.joint_filter
import numpy as np
square = np.ones((500, 500))
square @ square
np.linalg.solve(square + 500.0 * np.eye(500), square)
print(len(os.listdir("/proc/self/task")))
"""


def test_blas_starts_no_threads() -> None:
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", RECKON], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "1"
