"""The central estimator of a robot swarm, its replay, its player and its reports."""

import os

# The matrices are too small to share: where other programs run, BLAS threads wait for each other a hundred
# times longer than they reckon. Must be set before numpy loads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
