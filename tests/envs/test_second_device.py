"""On a device other than the CPU, all is computed there, with the same results."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor

from egoskin.agents.ppo import PPO
from egoskin.agents.rollout import collect
from egoskin.envs.randomization import RandomizationConfig
from egoskin.evaluation.throw_set import play_throws
from egoskin.make import EnvConfig, make_env, make_worker_env
from egoskin.policies.policy import PolicySpec, load_policy
from egoskin.runs.config import TrainConfig
from egoskin.runs.run import Run
from egoskin.runs.trainer import open_trainer, sparse_sources
from egoskin.sensors.config import SensorConfig
from second_device import AVAILABLE, DEVICE, Labelled, OnSecondDevice, second_device
from throwing import TASK

# Each operation takes ten times as long as on the CPU.
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not AVAILABLE, reason="this version of PyTorch has no devices in Python"
    ),
]
RANDOM = RandomizationConfig(
    link_mass=(0.9, 1.1), delay_steps=(0, 1), push_speed=(0.1, 0.2)
)
CONFIGS = {
    "field": EnvConfig(task=replace(TASK, randomization=RANDOM), previous_action=True),
    "ray": EnvConfig(task=TASK, sensor=SensorConfig(coverage="ray")),
    "ray, reduced": EnvConfig(
        task=TASK,
        sensor=SensorConfig(coverage="ray", reduce="min", corruption="acoustic"),
        history=3,
    ),
    "time of flight": EnvConfig(
        task=TASK, sensor=SensorConfig(coverage="ray", corruption="time_of_flight")
    ),
    "localization": EnvConfig(
        task=TASK, sensor=SensorConfig(signal="localization", keep_last=True)
    ),
    "oracle": EnvConfig(
        task=TASK, sensor=SensorConfig(coverage="oracle"), privileged="velocity"
    ),
}


@pytest.fixture
def engine(monkeypatch):
    """The engine of the device, whatever name it is asked for by."""
    _use_device(monkeypatch)


def _use_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """From here on, all environments are on the device."""
    monkeypatch.setattr("egoskin.make.engine_of", lambda name: OnSecondDevice)
    for module in ("make", "runs.trainer"):
        monkeypatch.setattr(f"egoskin.{module}.device_of", lambda name: DEVICE)


def test_tensors_of_two_devices_do_not_meet():
    with second_device() as device:
        own = torch.zeros(4, 3, device=device)
        own[1:, 0] += 2.0
        assert own.device == device
        assert float(own.sum()) == 6.0
        with pytest.raises(RuntimeError, match=r"aten::add: a tensor \(3,\) on cpu be"):
            _ = own + torch.ones(3)
        with pytest.raises((RuntimeError, TypeError)):
            own.numpy()


def rollout(config: EnvConfig, device: torch.device | str) -> dict[str, Tensor]:
    """The rollout of an untrained agent."""
    skin = config.skin.build(config.robot_config)
    sources = sparse_sources(config, skin)
    env = make_worker_env(
        config, skin, num_envs=8, seed=0, sparse=bool(sources), device=device
    )
    spec = PolicySpec.of(config, skin, TrainConfig().ppo.network, env, sources)
    torch.manual_seed(0)
    agent = spec.build_agent(sources).to(device)
    found, _, _ = collect(env, agent, env.reset(), 45, ["terminated"], 0.5)
    tensors = found.flatten_keys("/").items()
    return {key: x.detach() for key, x in tensors if isinstance(x, Tensor)}


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
def test_a_rollout_is_computed_on_the_device(config, monkeypatch):
    expected = rollout(config, "cpu")
    _use_device(monkeypatch)
    with second_device() as device:
        found = rollout(config, device)
    assert found.keys() == expected.keys()
    assert expected["terminated"].any()
    for key, value in found.items():
        assert isinstance(value, Labelled), key
        assert torch.equal(value.content, expected[key]), key


@pytest.mark.parametrize("workers", [0, 2])
def test_an_environment_moved_to_the_device_still_simulates_on_the_cpu(workers):
    def steps(device: torch.device | None = None) -> list[TensorDictBase]:
        own = {"config": CONFIGS["ray, reduced"], "num_envs": 4, "seed": 0}
        env = make_env(**own, num_workers=2) if workers else make_worker_env(**own)
        if device is not None:
            env = env.to(device)
        torch.manual_seed(0)
        root, found = env.reset(), []
        for _ in range(40):
            root["action"] = 3 * torch.randn(env.action_spec.shape).to(env.device)
            step, root = env.step_and_maybe_reset(root)
            found.append(step)
        env.close()
        return found

    expected = steps()
    assert any(step["next", "done"].any() for step in expected)
    with second_device() as device:
        for found, step in zip(steps(device), expected, strict=True):
            for key, value in found.items(True, True):
                assert isinstance(value, Labelled), key
                assert torch.equal(value.content, step[key]), key


def test_a_run_on_the_device_is_saved_and_resumed(engine, tmp_path, monkeypatch):
    def step(self, data, index):
        # Without gradients.
        data[index]
        zero = torch.zeros((), device=DEVICE)
        return {"loss_actor": zero, "loss_critic": zero, "entropy": zero}

    monkeypatch.setattr(PPO, "step", step)
    config = TrainConfig(engine="warp", num_envs=32, run_dir=tmp_path / "run")
    with second_device():
        with open_trainer(Run.create(config)) as trainer:
            trainer.iterate()
            trainer.save()
            trainer.keep_policy()
            expected = trainer.iterate()
        with open_trainer(Run.open(tmp_path / "run")) as trainer:
            found = trainer.iterate()
    for key in ("frames", "reward/mean", "ppo/kl", "episode/survival_s"):
        assert found[key] == expected[key]


def test_a_policy_is_evaluated_on_the_device(monkeypatch):
    policy = load_policy("field_proximity")
    args = (policy.env_config, policy.skin)
    expected = play_throws(policy, *args, throw_set=0, episodes=4)
    _use_device(monkeypatch)
    policy = load_policy("field_proximity")
    with second_device() as device:
        found = play_throws(
            policy, *args, throw_set=0, episodes=4, engine="warp", device=device
        )
    assert torch.equal(found.steps, expected.steps)
    assert torch.equal(found.hit, expected.hit)
