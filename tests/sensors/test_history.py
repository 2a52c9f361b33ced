"""History and last signal, compared with values by hand."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from egoskin.envs.dodgeball import DodgeballEnv
from egoskin.robots.builtin import H1_2
from egoskin.sensors import FieldSensor, Localization, place_sensors
from egoskin.sensors.history import History, KeepLast
from throwing import TASK


def stored(done: list[int], **entries: torch.Tensor) -> TensorDict:
    """One row of steps in order; a step with done is the last of its episode."""
    flags = torch.tensor(done, dtype=torch.bool)[:, None]
    return TensorDict({**entries, "next": {"done": flags}}, batch_size=[len(done)])


def test_history_by_hand():
    # Two numbers a step, episodes of three steps and of two.
    values = torch.tensor([[1.0, -1], [2, -2], [3, -3], [4, -4], [5, -5]])
    data = History(3)(stored([0, 0, 1, 0, 0], signal=values))
    expected = [
        [1, -1, 1, -1, 1, -1],
        [1, -1, 1, -1, 2, -2],
        [1, -1, 2, -2, 3, -3],
        [4, -4, 4, -4, 4, -4],
        [4, -4, 4, -4, 5, -5],
    ]
    assert data["signal_history"].tolist() == expected


def test_history_of_a_grid_grows_along_its_beams():
    # [T, S, K] = [2, 2, 2]
    values = torch.arange(8.0).reshape(2, 2, 2)
    history = History(2)(stored([0, 0], signal=values))["signal_history"]
    assert history.tolist() == [
        [[0, 1, 0, 1], [2, 3, 2, 3]],
        [[0, 1, 4, 5], [2, 3, 6, 7]],
    ]


def test_history_of_one_is_the_value_itself():
    values = torch.rand(4, 3)
    history = History(1)(stored([0, 1, 0, 0], signal=values))["signal_history"]
    assert torch.equal(history, values)


def test_history_is_bounded_where_its_entry_is():
    spec = Composite(
        near=Bounded(0.0, torch.tensor([1.0, 2.0]).expand(4, 2), shape=(4, 2)),
        free=Unbounded(shape=(4, 3), dtype=torch.float64),
        shape=[4],
    )
    history = History(2, ["near", "free"], ["nears", "frees"])
    spec = history.transform_observation_spec(spec)
    assert isinstance(spec["nears"], Bounded)
    assert spec["nears"].space.high[0].tolist() == [1, 2, 1, 2]
    assert spec["nears"].space.low[0].tolist() == [0, 0, 0, 0]
    assert spec["frees"].shape == (4, 6)
    assert spec["frees"].dtype == torch.float64


def test_the_last_signal_by_hand():
    signal = torch.tensor([[0.0], [1], [2], [0], [0], [0], [5], [0]])
    seen = torch.tensor(
        [[0, 0], [1, 0], [0, 1], [0, 0], [0, 0], [0, 0], [1, 1], [0, 0]]
    )
    data = stored([0, 0, 0, 0, 1, 0, 0, 0], signal=signal, object_detected=seen.bool())
    last = KeepLast()(data)["last_signal"][:, 0].tolist()
    # The episode that starts at step 5 contains nothing of the previous one.
    assert last == [0, 1, 2, 2, 2, 0, 5, 5]


def test_what_sensors_of_any_kind_detect_is_kept():
    # A skin with two kinds of sensors has two detection keys.
    signal = torch.tensor([[1.0], [2], [3]])
    field = torch.tensor([[1], [0], [0]]).bool()
    ray = torch.tensor([[0], [1], [0]]).bool()
    data = stored([0, 0, 0], signal=signal, field=field, ray=ray)
    keep = KeepLast(["signal", "field", "ray"])
    assert keep(data)["last_signal"].tolist() == [[1], [2], [2]]


def test_a_detected_zero_is_a_sight():
    signal, seen = torch.tensor([[1.0], [0.0]]), torch.ones(2, 1).bool()
    data = stored([0, 0], signal=signal, object_detected=seen)
    assert KeepLast()(data)["last_signal"].tolist() == [[1], [0]]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((0,), "length must be an integer, at least 1, got 0"),
        ((2.5,), "at least 1, got 2.5"),
        ((2, ["a", "b"], ["c"]), "need one out key per in key"),
    ],
)
def test_what_makes_no_history_is_refused(arguments, text):
    with pytest.raises(ValueError, match=text):
        History(*arguments)


def test_the_last_position_and_its_history_in_the_task():
    skin = place_sensors(H1_2, 12, seed=0)
    balls = TASK.throws.balls
    env = TransformedEnv(
        DodgeballEnv(H1_2, TASK, num_envs=6, seed=0),
        Compose(
            [
                FieldSensor(skin, H1_2.chain, balls, 1.5),
                Localization(),
                KeepLast(),
                History(2, ["last_signal"], ["signals"]),
            ]
        ),
    )
    check_env_specs(env)
    data = env.rollout(80, break_when_any_done=False)
    seen = data["object_detected"].any(-1)
    signal, last = data["signal"], data["last_signal"]
    assert signal[seen].any()
    assert torch.equal(last[seen], signal[seen])
    assert not signal[~seen].any()
    lost = ~seen[:, 1:] & ~data["next", "done"][:, :-1, 0]
    assert torch.equal(last[:, 1:][lost], last[:, :-1][lost])
    assert torch.equal(data["signals"][..., 3:], last)
