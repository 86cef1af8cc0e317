"""Texts that select markers."""

import pytest

from swarm_loc_estimator.common.parameters import ParameterError
from swarm_loc_vision.markers.detector import parse_ids, parse_lengths


def test_ids() -> None:
    assert parse_ids("ids", ["7", "0-2", " 2-3 "], 10).tolist() == [0, 1, 2, 3, 7]
    assert parse_ids("ids", [], 10).tolist() == []


@pytest.mark.parametrize("text", ["", "a", "-1", "3-", "5-3", "10", "0-10", "1.5"])
def test_what_is_no_id_is_refused(text: str) -> None:
    with pytest.raises(ParameterError):
        parse_ids("ids", [text], 10)


def test_lengths() -> None:
    assert parse_lengths(["1-2:0.08", "5:.03"], 10) == {1: 0.08, 2: 0.08, 5: 0.03}


@pytest.mark.parametrize("text", ["1", "1:", "1:0", "1:-0.1", "1:11", "10:0.1", ":0.1", "1:0.1m"])
def test_what_is_no_length_is_refused(text: str) -> None:
    with pytest.raises(ParameterError):
        parse_lengths([text], 10)
