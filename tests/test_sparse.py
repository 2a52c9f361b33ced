"""Sparse rows: a layer with the dense one's results, and rays without their grid."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from egoskin.agents.networks import Agent, NetworkConfig
from egoskin.agents.normalizers import SignalNorm
from egoskin.agents.ppo import PPO, PPOConfig
from egoskin.agents.rollout import collect
from egoskin.make import EnvConfig, make_env
from egoskin.policies.policy import (
    PolicySpec,
    agent_tensors,
    load_policy,
    save_policy,
    sparse_sources,
)
from egoskin.robots.builtin import H1_2
from egoskin.sensors import Ray, RaySensor, SensorPipeline, place_sensors
from egoskin.sensors.config import SensorConfig
from egoskin.shapes import Sphere
from egoskin.sparse import SparseRows
from sensing import KINDS, SHAPES
from throwing import TASK

SKIN = place_sensors(H1_2, 16, seed=0)
RAYS = SensorConfig(coverage="ray")
KEYS = ("base_pose", "joint_pos", "object_pose", "object_active")


def rows_of(matrix: torch.Tensor, default: float) -> SparseRows:
    row, column = (matrix != default).nonzero(as_tuple=True)
    counts = torch.bincount(row, minlength=len(matrix))
    return SparseRows(
        offsets=torch.cat((counts.new_zeros(1), counts.cumsum(0))),
        column=column,
        value=matrix[row, column],
        size=matrix.shape[1],
        default=default,
    )


def draw(seed: int, rows: int, columns: int, default: float) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    matrix = torch.rand(rows, columns, generator=generator)
    matrix[torch.rand(rows, columns, generator=generator) < 0.9] = default
    return matrix


# Seed, rows, columns, and what almost all entries are.
every_matrix = given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 40),
    st.integers(1, 70),
    st.sampled_from([0.0, 1.0]),
)


@every_matrix
def test_a_layer_of_sparse_rows_is_that_of_the_matrix(seed, rows, columns, default):
    matrix = draw(seed, rows, columns, default)
    sparse = rows_of(matrix, default)
    assert torch.equal(sparse.dense(), matrix)
    torch.manual_seed(seed)
    layer = torch.nn.Linear(columns, 5)
    there = torch.randn(rows, 5)
    expected = layer(matrix)
    wanted = torch.autograd.grad(expected, [layer.weight, layer.bias], there)
    result = sparse.linear(layer.weight, layer.bias)
    torch.testing.assert_close(result, expected, rtol=1e-4, atol=1e-5)
    grads = torch.autograd.grad(result, [layer.weight, layer.bias], there)
    torch.testing.assert_close(grads, wanted, rtol=1e-4, atol=1e-4)


@given(st.integers(0, 2**32 - 1), st.integers(1, 30), st.integers(0, 50))
def test_rows_are_selected_and_joined_like_those_of_the_matrix(seed, rows, wanted):
    matrix = draw(seed, rows, 20, 1.0)
    index = torch.randint(rows, (wanted,))
    sparse = rows_of(matrix, 1.0)
    assert torch.equal(sparse.select(index).dense(), matrix[index])
    joined = SparseRows.cat([sparse, sparse.select(index)])
    assert torch.equal(joined.dense(), torch.cat((matrix, matrix[index])))
    assert len(joined) == rows + wanted


# --- rays -------------------------------------------------------------------------


@pytest.mark.parametrize("ray", [Ray(), Ray(measure="depth")])
def test_hits_are_the_readings_of_the_grid(random_state, ray):
    state = random_state(300, seed=1, objects=3)
    # Two coincident objects, and a row of NaN.
    state["object_pose"][:50, 1] = state["object_pose"][:50, 0]
    state["joint_pos"][7, 3] = float("nan")
    objects = (Sphere(radius=0.25), Sphere(radius=0.2), Sphere(radius=0.1))
    sensor = RaySensor(SKIN, H1_2.chain, objects, 1.5, ray)
    inputs = [state[key] for key in KEYS]
    place, distance = sensor.hits(*inputs)
    grid = sensor.compute(*inputs)[0].flatten()
    assert torch.equal(place, (grid != torch.inf).nonzero()[:, 0])
    torch.testing.assert_close(distance, grid[place], rtol=0, atol=0, equal_nan=True)
    assert distance.isnan().any()
    assert len(place) > 1000


@pytest.mark.parametrize("signal", ["proximity", "closeness", "binary"])
@pytest.mark.parametrize("shape", SHAPES, ids=KINDS)
def test_the_sparse_signal_is_that_of_the_transforms(random_state, signal, shape):
    pipeline = SensorPipeline(replace(RAYS, signal=signal), H1_2, SKIN)
    objects = (shape,) * 3
    rays = pipeline.sparse_rays(objects)
    state = random_state(200, seed=2, objects=3)
    dense = state.clone()
    for transform in pipeline.transforms(objects, dt=1 / 60):
        transform(dense)
    assert torch.equal(rays(state).dense(), dense["signal"])
    # A batch of another size than the first.
    assert torch.equal(rays(state[:9]).dense(), dense["signal"][:9])


def test_nothing_in_reach_is_no_hit(random_state):
    pipeline = SensorPipeline(RAYS, H1_2, SKIN)
    rays = pipeline.sparse_rays((Sphere(radius=0.25),))
    state = random_state(20, seed=0, objects=1)
    state["object_active"][:] = False
    assert torch.equal(rays(state).dense(), torch.ones(20, 16 * 64))


@pytest.mark.parametrize(
    "change",
    [
        {"coverage": "field"},
        {"coverage": "none"},
        {"signal": "localization"},
        {"reduce": "min"},
        {"corruption": "time_of_flight"},
    ],
)
def test_whatever_is_not_sparse_is_left_to_the_transforms(change):
    config = EnvConfig(sensor=replace(RAYS, **change))
    assert sparse_sources(config, SKIN) == {}


def test_histories_and_mixed_skins_are_left_as_well():
    config = EnvConfig(sensor=RAYS)
    assert set(sparse_sources(config, SKIN)) == {"signal"}
    assert not sparse_sources(replace(config, history=2), SKIN)
    coverage = (Ray(), Ray(grid=(4, 4)), *SKIN.coverage[2:])
    assert not sparse_sources(config, replace(SKIN, coverage=coverage))
    reach = np.full(len(SKIN), 2.0)
    assert sparse_sources(config, replace(SKIN, range=reach))
    reach[3] = 1.0
    assert not sparse_sources(config, replace(SKIN, range=reach))


@every_matrix
def test_sparse_rows_are_normalised_as_the_matrix_is(seed, rows, columns, default):
    one, other = SignalNorm(columns), SignalNorm(columns)
    for part in range(3):
        matrix = draw(seed + part, rows, columns, default)
        sparse = rows_of(matrix, default)
        assert torch.equal(one.sparse(sparse).dense(), one(matrix))
        one.update(matrix)
        other.update(sparse)
        torch.testing.assert_close(other.mean, one.mean)
        torch.testing.assert_close(other.var, one.var, atol=1e-15, rtol=1e-9)
        assert other.count == one.count


def test_rows_that_are_not_finite_are_found():
    matrix = draw(0, 30, 20, 1.0)
    matrix[3, 5] = torch.nan
    matrix[7, 1] = torch.inf
    finite = rows_of(matrix, 1.0).is_finite()
    assert (~finite).nonzero()[:, 0].tolist() == [3, 7]


# --- agents -----------------------------------------------------------------------


def rollout_of(
    sparse: bool, network: NetworkConfig
) -> tuple[Agent, TensorDict, PolicySpec]:
    """An untrained agent and what it collects while the first balls arrive."""
    config = EnvConfig(task=TASK, sensor=RAYS)
    sources = sparse_sources(config, SKIN) if sparse else {}
    env = make_env(
        config, SKIN, num_envs=32, num_workers=1, seed=0, sparse=bool(sources)
    )
    try:
        torch.manual_seed(0)
        spec = PolicySpec.of(config, SKIN, network, env, sources)
        agent = spec.build_agent(sources)
        root = env.reset()
        for _ in range(3):
            rollout, root, _ = collect(env, agent, root, 16)
    finally:
        env.close()
    return agent, rollout, spec


@pytest.mark.parametrize("normalize", ["body", "all"])
def test_an_agent_collects_the_same_from_hits_as_from_the_grid(normalize):
    network = NetworkConfig(normalize=normalize)
    agent, rollout, _ = rollout_of(True, network)
    dense_agent, dense, _ = rollout_of(False, network)
    tensors, dense_tensors = agent_tensors(agent), agent_tensors(dense_agent)
    assert tensors.keys() == dense_tensors.keys()
    assert all(torch.equal(tensors[key], dense_tensors[key]) for key in tensors)
    rows, matrix = rollout["inputs", "signal"], dense["inputs", "signal"]
    assert isinstance(rows, SparseRows)
    assert len(rows.value) > 100
    # Actions differ by rounding, and so do their consequences.
    same = (rows.dense().reshape_as(matrix) - matrix).abs() < 1e-3
    assert same.float().mean() > 0.999
    for key in ("loc", "state_value", "next_state_value"):
        torch.testing.assert_close(rollout[key], dense[key], atol=1e-2, rtol=1e-3)


def test_an_update_from_hits_is_that_from_the_grid(tmp_path):
    agent, rollout, spec = rollout_of(True, NetworkConfig())
    rows = rollout["inputs", "signal"]
    dense = rollout.clone()
    del dense["inputs", "signal"]
    dense["inputs", "signal"] = rows.dense().reshape(16, 32, -1)
    results = []
    for data in (rollout, dense):
        torch.manual_seed(0)
        learner = copy.deepcopy(agent)
        config = PPOConfig(ppo_epochs=1, num_mini_batches=1, desired_kl=None)
        metrics = PPO(learner, config).update(data)
        results.append((metrics, {k: p.grad for k, p in learner.named_parameters()}))
    (metrics, gradients), (expected, wanted) = results
    assert metrics == pytest.approx(expected, rel=1e-3, abs=1e-6)
    assert metrics["grad_norm_actor"] > 0
    for key, value in gradients.items():
        torch.testing.assert_close(value, wanted[key], atol=1e-5, rtol=1e-3)
    # A policy that learnt from hits is one of the grid.
    path = tmp_path / "policy.safetensors"
    save_policy(path, agent, spec)
    flat = dense.reshape(-1)
    flat["signal"] = rollout["signal"].dense()
    given = flat["loc"]
    loc = load_policy(path)(flat.select("observation", "signal"))["action"]
    torch.testing.assert_close(loc, given, atol=1e-5, rtol=1e-4)
