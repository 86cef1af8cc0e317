"""Messages that are lost on purpose: by seed and message, whatever is read at once; never ground truth."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from bench.shared.bags import copy_part
from swarm_loc_estimator.common.messages.streams import MessageBatch, SerializedMessage
from swarm_loc_estimator.offline.recorded_bag import Loss, LossError, Network
from swarm_loc_estimator.offline.replay import replay

DEMO = Path(__file__).parents[3] / "bags" / "eight_one_robot_fast"
NAMES = ["a/odom", "b/odom"]


def batch(topics: list[int]) -> MessageBatch:
    """Messages of these topics, whose bytes say their numbers."""
    return MessageBatch.of([SerializedMessage(one, b"%d" % k, k) for k, one in enumerate(topics)])


TOPICS = [int(one) for one in np.random.default_rng(1).integers(0, 2, 4000)]


def kept(loss: Loss, cuts: list[int], topics: list[int] = TOPICS) -> set[int]:
    """Numbers of the messages that pass, of batches cut at these places."""
    network, whole, passed = Network(loss, NAMES), batch(topics), list[int]()
    for begin, end in zip([0, *cuts], [*cuts, whole.size], strict=True):
        passed += [log_ns for _, log_ns, _ in network.passed(whole.chosen(slice(begin, end))).messages()]
    assert network.lost == len(topics) - len(passed)
    return {*passed}


def test_the_same_messages_are_lost_whatever_is_read_at_once() -> None:
    loss = Loss(0.3, 7)
    once = kept(loss, [])
    assert once == kept(loss, [1, 17, 1500])
    assert 0.68 < len(once) / len(TOPICS) < 0.72
    assert once != kept(Loss(0.3, 8), [])
    assert kept(Loss(0.0, 7), []) == set(range(len(TOPICS)))


def test_what_is_lost_of_a_topic_does_not_depend_on_others() -> None:
    mixed = kept(Loss(0.5, 3), [])
    own = [k for k, topic in enumerate(TOPICS) if topic == 0]
    alone = kept(Loss(0.5, 3), [], [0] * len(own))
    assert {own[k] for k in alone} == {k for k in mixed if TOPICS[k] == 0}
    other = kept(Loss(0.5, 3), [], [1] * len(own))
    assert alone != other


def test_a_greater_share_loses_the_same_and_more() -> None:
    assert kept(Loss(0.6, 2), []) < kept(Loss(0.2, 2), [])


def test_a_replay_with_losses_is_the_same_twice_and_has_all_of_the_truth(tmp_path: Path) -> None:
    copy_part(DEMO, tmp_path / "bag", 5.0)
    shutil.copy(DEMO / "swarm.yaml", tmp_path / "bag")
    whole = replay(tmp_path / "bag")
    first, second, other = (replay(tmp_path / "bag", loss=Loss(0.4, seed)) for seed in (1, 1, 2))
    assert first.poses.tobytes() == second.poses.tobytes()
    assert not np.array_equal(first.poses, other.poses)
    received = [
        sum(n for name, n in one.counters.items() if name.startswith("messages")) for one in (whole, first)
    ]
    lost = received[0] - received[1]
    assert 0.3 < lost / received[0] < 0.5
    assert f"{lost} messages were dropped at random: 0.4 of all." in first.remarks
    (name,) = whole.truth
    assert len(first.truth[name].stamp_ns) == len(whole.truth[name].stamp_ns)


@pytest.mark.parametrize(
    ("share", "seed", "said"),
    [
        (1.0, 0, r"share = 1.0 of a loss must lie in \[0, 0.99\]"),
        (float("nan"), 0, "share = nan"),
        (0.1, -1, "seed = -1 of a loss must lie in"),
    ],
)
def test_a_loss_out_of_range_is_refused(share: float, seed: int, said: str) -> None:
    with pytest.raises(LossError, match=said):
        Loss(share, seed)
