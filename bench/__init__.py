"""Benchmarks: each prints a table, draws it under out/ and leaves its figures in out/bench/.

`make bench-NAME` runs `python -m bench NAME`, which knows them all.
"""

import os

# CPU seconds are those of one core; idle BLAS threads burn time in spinning. Must be set before numpy loads.
for _library in ("OPENBLAS", "OMP", "MKL"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")
