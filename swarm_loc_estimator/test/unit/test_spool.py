"""What is spooled comes back as it was, key by key, and stays when the spool is gone."""

from __future__ import annotations

import numpy as np
import pytest

from swarm_loc_estimator.offline.result import Spool


def test_rows_come_back_by_key_in_their_order() -> None:
    rng = np.random.default_rng(1)
    spool = Spool()
    parts = {key: [rng.normal(size=(int(rng.integers(0, 3000)), 2, 3)) for _ in range(20)] for key in "ab"}
    for k in range(20):
        for key, rows in parts.items():
            spool.append(key, rows[k])
    arrays = {key: spool.array(key, np.float64, 2, 3) for key in parts}
    nothing = spool.array("c", np.int64)
    del spool
    for key, rows in parts.items():
        np.testing.assert_array_equal(arrays[key], np.concatenate(rows))
    assert nothing.shape == (0,)
    with pytest.raises(ValueError, match="read-only"):
        arrays["a"][0] = 0.0
