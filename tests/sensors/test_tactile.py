"""Tactile: contacts from forces, rewards and ends from contacts, contact-free data."""

from __future__ import annotations

from functools import partial
from typing import Any

import mujoco
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import Compose, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from egoskin.envs.dodgeball import DodgeballEnv
from egoskin.robots.builtin import H1_2
from egoskin.sensors.tactile import (
    ContactFree,
    ContactPenalty,
    ContactTermination,
    Tactile,
    contact_free,
    split_by_contact,
)
from throwing import TASK, wild_actions

LINKS = ("base", "left_arm", "right_arm", "foot")
BODY = [name for name in H1_2.links if name not in H1_2.feet]


def columns(*rows: str) -> torch.Tensor:
    """Flags from rows of text: x is true."""
    return torch.tensor([[c == "x" for c in row] for row in rows])


# --- contact from force ---------------------------------------------------------


def test_a_link_is_touched_above_the_threshold():
    # |(3, 0, 4)| = 5 N: not above 5.
    force = torch.tensor([[[3.0, 0, 4], [3, 0.1, 4], [0, 0, 0], [0, -6, 0]]])
    state = TensorDict(contact_force=force, batch_size=[1])
    assert Tactile(5.0)(state)["tactile"].tolist() == [[False, True, False, True]]


def test_torque_is_not_force():
    # MuJoCo's order: torque (100 N m), then force (1 N).
    state = TensorDict(
        contact_force=torch.tensor([[[100.0, 0, 0, 0, 0, 1.0]]]), batch_size=[1]
    )
    assert not Tactile(1.0)(state)["tactile"].any()
    assert Tactile(0.5)(state)["tactile"].all()


def test_a_force_that_is_no_number_is_a_contact():
    state = TensorDict(
        contact_force=torch.tensor([[[torch.nan, 0, 0], [0, 0, 0]]]), batch_size=[1]
    )
    assert Tactile(1.0)(state)["tactile"].tolist() == [[True, False]]


@pytest.mark.parametrize("shape", [(2, 4), (2, 4, 2)])
def test_forces_that_are_no_vectors_are_refused(shape):
    state = TensorDict(contact_force=torch.zeros(shape), batch_size=[2])
    with pytest.raises(ValueError, match=r"must be \[\*B, L, n\], n >= 3.*; got \[4"):
        Tactile(1.0)(state)


def test_a_ball_at_rest_on_the_floor_is_touched_by_its_weight():
    # 2 kg: 19.62 N. The second ball hangs in the air.
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><geom type="plane" size="1 1 1"/>
        <body pos="0 0 0.1"><freejoint/><geom size="0.1" mass="2"/></body>
        <body pos="1 0 0.5"><geom size="0.1" mass="2"/></body>
        </worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    for _ in range(1000):
        mujoco.mj_step(model, data)
    mujoco.mj_rnePostConstraint(model, data)
    state = TensorDict(contact_force=torch.from_numpy(data.cfrc_ext[1:]), batch_size=[])
    assert Tactile(19.0)(state)["tactile"].tolist() == [True, False]
    assert Tactile(20.0)(state)["tactile"].tolist() == [False, False]


def test_tactile_works_offline_with_nested_keys_and_a_time_dimension():
    force = torch.randn(4, 5, 3, 6, generator=torch.Generator().manual_seed(0))
    transform = Tactile(2.0, [("next", "force")], [("next", "touch")])
    state = TensorDict({"next": {"force": force}}, batch_size=[4, 5])
    touch = transform(state)["next", "touch"]
    assert torch.equal(touch, force[..., 3:].square().sum(-1) > 4)
    assert 0 < touch.sum() < touch.numel()
    spec = Composite(force=Unbounded(force.shape), shape=[4, 5])
    spec = Tactile(2.0, ["force"]).transform_observation_spec(spec)
    assert spec["tactile"].is_in(touch)


@pytest.mark.parametrize("threshold", [-1.0, float("nan")])
def test_a_threshold_that_is_none_is_refused(threshold):
    with pytest.raises(ValueError, match="must not be negative"):
        Tactile(threshold)


# --- rewards --------------------------------------------------------------------


@pytest.mark.parametrize("prices", [{}, {"*": float("nan")}, {"*": float("inf")}])
def test_prices_that_are_none_are_refused(prices):
    with pytest.raises(ValueError, match="prices must be finite and not empty"):
        ContactPenalty(LINKS, prices)


def test_a_penalty_adds_up_the_prices_of_the_links_touched():
    transform = ContactPenalty(LINKS, {"*_arm": 0.5, "base": 2.0, "left_*": 0.25})
    state = TensorDict(
        tactile=columns("....", "xxxx", ".x.x"),
        reward=torch.tensor([[1.0], [1.0], [-1.0]]),
        batch_size=[3],
    )
    # All: 2 + 0.5 + 0.5 + 0.25 (the left arm matches twice); the foot is free.
    expected = torch.tensor([[1.0], [1 - 3.25], [-1 - 0.75]])
    torch.testing.assert_close(transform(state)["reward"], expected)


def test_a_reward_with_a_penalty_is_no_longer_bounded():
    spec = Composite(reward=Bounded(0.0, 1.0, shape=(3, 1)), shape=[3])
    spec = ContactPenalty(LINKS, {"*": 1.0}).transform_reward_spec(spec)
    assert spec["reward"].is_in(torch.full((3, 1), -4.0))


@pytest.mark.parametrize(
    "build",
    [
        lambda name: ContactPenalty(LINKS, {name: 1.0}),
        lambda name: ContactTermination(LINKS, [name]),
    ],
)
def test_an_unknown_link_is_refused_with_the_closest(build):
    with pytest.raises(ValueError, match="no link 'left_arn', did you mean "):
        build("left_arn")


# --- ends -----------------------------------------------------------------------


def test_contact_of_a_counted_link_ends_and_leaves_other_ends():
    transform = ContactTermination(LINKS, ["base", "*_arm"])
    state = TensorDict(
        tactile=columns("....", "..x.", "...x", "x...", "...."),
        terminated=columns(".", ".", ".", "x", "x"),
        truncated=columns(".", "x", ".", ".", "."),
        done=columns(".", "x", ".", "x", "x"),
        batch_size=[5],
    )
    result = transform(state)
    assert torch.equal(result["terminated"], columns(".", "x", ".", "x", "x"))
    assert torch.equal(result["truncated"], columns(".", "x", ".", ".", "."))
    assert torch.equal(result["done"], columns(".", "x", ".", "x", "x"))


def run(env, steps: int) -> Any:
    """Steps ``[T, rows]`` of an environment under fixed actions, with resets."""
    stored, root = [], env.reset()
    for action in wild_actions(root.numel(), steps):
        root["action"] = action.reshape(*root.batch_size, -1)
        step, root = env.step_and_maybe_reset(root)
        stored.append(step.reshape(-1).clone())
    return torch.stack(stored)


TRANSFORMS = {
    # Feet count too: robots start on their feet, so they end at their first step.
    "feet": lambda: [ContactTermination(H1_2.links)],
    "arms": lambda: [ContactTermination(H1_2.links, ["*_elbow_link", "*_hip_*"])],
    "free": lambda: [ContactFree(H1_2.links, BODY)],
    "penalty": lambda: [ContactPenalty(H1_2.links, {"*_ankle_*": 0.1})],
}


def base(rows: int, offset: int = 0) -> DodgeballEnv:
    return DodgeballEnv(H1_2, TASK, num_envs=rows, seed=3, row_offset=offset)


@pytest.mark.parametrize("build", TRANSFORMS.values(), ids=TRANSFORMS)
def test_environments_keep_their_specs(build):
    check_env_specs(TransformedEnv(base(3), Compose(*build())))


def test_rewards_in_an_environment_are_those_of_its_contacts():
    env = TransformedEnv(base(6), *TRANSFORMS["penalty"]())
    step = run(env, 60)["next"]
    ankles = torch.tensor(["_ankle_" in name for name in H1_2.links])
    price = 0.1 * (step["tactile"] & ankles).sum(-1, keepdim=True)
    plain = step["reward_terms"].sum(-1, keepdim=True)
    torch.testing.assert_close(step["reward"], plain - price)
    assert price.max() > 0


@pytest.mark.parametrize("where", ["inside", "around"])
def test_episodes_end_at_contact_and_the_rows_start_again(where):
    ends = ["*_hip_*", "*_shoulder_*", "torso_link"]
    end = partial(ContactTermination, H1_2.links, ends)
    if where == "inside":
        bases = [lambda i=i: TransformedEnv(base(3, i), end()) for i in (0, 3)]
        env = SerialEnv(2, bases)
    else:
        bases = [partial(base, 3, i) for i in (0, 3)]
        env = TransformedEnv(SerialEnv(2, bases), end())
    steps = run(env, 70)
    env.close()
    after = steps["next"]
    counted = torch.tensor(
        [any(p in n for p in ("hip", "shoulder", "torso")) for n in H1_2.links]
    )
    touched = (after["tactile"] & counted).any(-1, keepdim=True)
    own = after["hit"] | after["fallen"] | after["diverged"]
    assert torch.equal(after["terminated"], touched | own)
    assert torch.equal(after["done"], after["terminated"] | after["truncated"])
    ended = after["done"][:-1, :, 0]
    assert torch.equal(steps["episode_step"][1:, :, 0] == 0, ended)
    per_step = ended.sum(1)
    assert ((per_step > 0) & (per_step < 6)).sum() >= 3  # partial resets happened


def test_feet_that_count_end_every_step():
    env = TransformedEnv(base(4), *TRANSFORMS["feet"]())
    assert run(env, 5)["next", "terminated"].all()


# --- contact-free data ----------------------------------------------------------


def test_a_trajectory_has_one_label_by_hand():
    # Trajectories 012 | 34 | 5: contact in the first; the last is not finished.
    done = columns("..x.x.")[..., None]
    tactile = torch.stack((columns(".x...."), columns("......")), -1)
    label = contact_free(tactile, done)
    assert torch.equal(label, columns("...xxx")[..., None])
    # At the last step of a trajectory, and in the first step of the next.
    assert torch.equal(
        contact_free(columns("....x.")[..., None], done), columns("xxx..x")[..., None]
    )
    assert torch.equal(
        contact_free(columns(".....x")[..., None], done), columns("xxxxx.")[..., None]
    )


flags = partial(hnp.arrays, bool)


@given(st.data())
def test_labels_are_those_of_a_loop(data):
    batch, steps, links = 3, 7, 2
    done = data.draw(flags((batch, steps, 1)))
    tactile = data.draw(flags((batch, steps, links), elements=st.booleans()))
    expected = done.copy()
    for b in range(batch):
        start = 0
        for t in range(steps):
            if done[b, t] or t == steps - 1:
                expected[b, start : t + 1] = not tactile[b, start : t + 1].any()
                start = t + 1
    label = contact_free(torch.from_numpy(tactile), torch.from_numpy(done))
    assert (label.numpy() == expected).all()


def test_data_is_split_into_whole_trajectories():
    done = columns("..x.x.", ".....x")[..., None]
    tactile = columns(".x....", "......")[..., None]
    data = TensorDict(step=torch.arange(12).reshape(2, 6), batch_size=[2, 6])
    free, touched = split_by_contact(data, tactile, done)
    steps = [piece["step"].tolist() for piece in free]
    assert steps == [[3, 4], [5], [6, 7, 8, 9, 10, 11]]
    assert [piece["step"].tolist() for piece in touched] == [[0, 1, 2]]


def test_a_split_works_on_any_batch_and_loses_no_step():
    generator = torch.Generator().manual_seed(0)
    done = torch.rand(2, 3, 9, 1, generator=generator) < 0.3
    tactile = torch.rand(2, 3, 9, 4, generator=generator) < 0.05
    data = TensorDict(step=torch.arange(54).reshape(2, 3, 9), batch_size=[2, 3, 9])
    label = contact_free(tactile, done)[..., 0]
    parts = split_by_contact(data, tactile, done)
    for part, mask in zip(parts, (label, ~label), strict=True):
        steps = torch.cat([piece["step"] for piece in part])
        assert torch.equal(steps, data["step"][mask])
        assert len(steps)


def labelled(where: str):
    """Environment of six rows with the label of what happened so far."""
    label = partial(ContactFree, H1_2.links, BODY)
    if where == "inside":
        return SerialEnv(
            2, [lambda i=i: TransformedEnv(base(3, i), label()) for i in (0, 3)]
        )
    return TransformedEnv(SerialEnv(2, [partial(base, 3, i) for i in (0, 3)]), label())


@pytest.mark.parametrize("where", ["inside", "around"])
def test_the_label_so_far_is_a_loop_over_the_steps(where):
    env = labelled(where)
    steps = run(env, 70)
    env.close()
    body = torch.tensor([name in BODY for name in H1_2.links])
    after = steps["next"]
    free = torch.ones(6, 1, dtype=torch.bool)
    for t in range(70):
        assert torch.equal(steps[t]["contact_free"], free)
        free = free & ~(after[t]["tactile"] & body).any(-1, keepdim=True)
        assert torch.equal(after[t]["contact_free"], free)
        free = free | after[t]["done"]  # a reset: no contact yet
    assert 3 <= after["done"].sum() < 70
    # At the last step of a trajectory it is the label of the whole.
    flags_ = (after[key].transpose(0, 1) for key in ("tactile", "done", "contact_free"))
    tactile, done, so_far = flags_
    whole = contact_free(tactile[..., body], done)
    assert torch.equal(whole[done], so_far[done])
    assert torch.equal(whole[:, -1], so_far[:, -1])


def test_the_label_so_far_of_stored_data_by_hand():
    # Two trajectories; feet (the second link) do not count.
    data = TensorDict(
        {
            "tactile": torch.stack((columns("..x..."), columns("xxxxxx")), -1)[0],
            "next": {"done": columns("...x..")[0, :, None]},
        },
        batch_size=[6],
    )
    label = ContactFree(["torso", "foot"], ["torso"])(data)["contact_free"]
    assert torch.equal(label, columns("xx..xx")[0, :, None])


@pytest.mark.parametrize("width", [1, 3, 5])
def test_contacts_of_other_links_are_refused(width):
    state = TensorDict(
        tactile=torch.zeros(2, 3, width, dtype=torch.bool),
        reward=torch.zeros(2, 3, 1),
        terminated=torch.zeros(2, 3, 1, dtype=torch.bool),
        done=torch.zeros(2, 3, 1, dtype=torch.bool),
        is_init=torch.zeros(2, 3, 1, dtype=torch.bool),
        batch_size=[2, 3],
    )
    for transform in (
        ContactPenalty(LINKS, {"*": 1.0}),
        ContactTermination(LINKS),
        ContactFree(LINKS),
    ):
        with pytest.raises(ValueError, match=f"holds {width} contacts .* for 4 links"):
            transform(state)
