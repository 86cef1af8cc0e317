"""What is spooled comes back as it was, key by key, and stays when the spool is gone."""

import gc
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

from bench.shared.full_disk import full_after
from swarm_loc_estimator.common.files import FileError
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


def filled(spool: Spool, rows: int) -> None:
    """Write rows, and read them."""
    spool.append("a", np.ones(rows))
    spool.array("a", float)


@pytest.mark.parametrize("rows", [20_001, 10])
def test_a_full_disk_is_said_with_its_folder_and_no_traceback(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, rows: int
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    unraised: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", unraised.append)
    spool = Spool()
    with full_after(8 * rows - 8):
        with pytest.raises(FileError, match=f"{tmp_path} cannot be written: File too large"):
            filled(spool, rows)
        del spool
        gc.collect()
    assert not unraised
