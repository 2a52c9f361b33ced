"""Checks of required against available memory."""

from __future__ import annotations

import os
import resource
from dataclasses import replace

import pytest

from egoskin.agents.networks import NetworkConfig
from egoskin.agents.ppo import PPOConfig
from egoskin.make import (
    EnvConfig,
    check_env_memory,
    check_num_workers,
    make_env,
    make_worker_env,
)
from egoskin.memory import (
    check_memory,
    check_shared_memory,
    is_out_of_memory,
    machine_memory,
)
from egoskin.runs.config import TrainConfig
from egoskin.runs.run import Run
from egoskin.sensors.config import SensorConfig

BLIND = EnvConfig(sensor=SensorConfig(coverage="none"))


def test_what_fits_is_taken_and_the_largest_need_is_named():
    there = machine_memory()
    assert 2**27 < there <= os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    check_memory({"networks": there // 2, "agents": there // 4})
    with pytest.raises(ValueError, match=r"at least .* most of it is for networks"):
        check_memory({"networks": there, "agents": there // 4})


def test_a_limit_of_the_address_space_counts():
    before = resource.getrlimit(resource.RLIMIT_AS)
    limit = machine_memory() - 2**20
    resource.setrlimit(resource.RLIMIT_AS, (limit, before[1]))
    try:
        assert machine_memory() == limit
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def test_a_limit_of_the_control_group_counts(monkeypatch):
    monkeypatch.setattr("egoskin.memory.memory_limit", lambda: 2**20)
    assert machine_memory() == 2**20


@pytest.mark.skipif(not os.path.isdir("/dev/shm"), reason="has no /dev/shm")
def test_shared_memory_that_is_not_there_is_refused():
    check_shared_memory(1, "a byte")
    with pytest.raises(ValueError, match=r"needed for agents; .*--shm-size"):
        check_shared_memory(2**50, "agents")


@pytest.mark.parametrize(
    ("config", "largest"),
    [
        (TrainConfig(num_envs=2**20, num_workers=1), "num_envs"),
        (
            TrainConfig(env=EnvConfig(history=256), num_envs=2**16, num_workers=1),
            "history",
        ),
        (
            TrainConfig(
                ppo=PPOConfig(network=NetworkConfig(hidden=(4096,) * 20)),
                num_workers=1,
            ),
            "ppo.network.hidden",
        ),
    ],
)
def test_a_training_that_does_not_fit_leaves_no_folder(
    config, largest, tmp_path, monkeypatch
):
    # A machine with 8 GB.
    monkeypatch.setattr("egoskin.memory.machine_memory", lambda: 8 * 10**9)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=f"needs at least .*{largest}"):
        Run.create(config)
    assert not list(tmp_path.iterdir())


def test_an_evaluation_that_does_not_fit_is_refused(monkeypatch):
    monkeypatch.setattr("egoskin.memory.machine_memory", lambda: 10**9)
    with pytest.raises(ValueError, match=r"needs at least .*episodes"):
        make_env(BLIND, num_envs=2**20, seed=0)
    # 256 steps of 48 values and the rest, before and after a step, in the worker and
    # sent to the parent: 4 x 256 x 48 x 4 bytes x 10,000 agents = 2 GB.
    long = make_worker_env(replace(BLIND, history=256), num_envs=1, seed=0)
    with pytest.raises(ValueError, match=r"at least 2\.\d GB .*history"):
        check_env_memory(long, 10_000)
    with pytest.raises(ValueError, match="episodes must be at most 1,048,576"):
        check_num_workers(10**9, None, "episodes")


def test_a_fault_of_ours_is_no_lack_of_memory():
    assert not is_out_of_memory(RuntimeError("size mismatch"))
    assert not is_out_of_memory(ValueError("not enough memory"))
