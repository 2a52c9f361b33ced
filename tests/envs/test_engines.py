"""Engines by name, and training with all tensors on the engine's device."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch

from calling import call
from egoskin.agents.ppo import PPO, PPOConfig
from egoskin.agents.rollout import collect
from egoskin.commands.evaluate import EvaluateConfig
from egoskin.envs.physics import engine_of
from egoskin.envs.physics.mujoco import MujocoPhysics
from egoskin.envs.randomization import RandomizationConfig
from egoskin.make import EnvConfig, make_worker_env
from egoskin.policies.policy import PolicySpec, sparse_sources
from egoskin.runs.config import TrainConfig
from egoskin.sensors.config import SensorConfig
from throwing import TASK


class OnCpu(MujocoPhysics):
    """MuJoCo, which supports only the CPU, while another device is the default."""


def _on_cpu(name: str):
    def method(self, *args, **kwargs):
        with torch.device("cpu"):
            return getattr(MujocoPhysics, name)(self, *args, **kwargs)

    return method


for _name in ("__init__", "reset", "throw", "vary", "push", "step", "read"):
    setattr(OnCpu, _name, _on_cpu(_name))


@pytest.mark.parametrize(
    "config",
    [
        EnvConfig(),
        EnvConfig(sensor=SensorConfig(coverage="ray"), previous_action=True),
        EnvConfig(sensor=SensorConfig(signal="localization", keep_last=True)),
    ],
    ids=["field", "ray", "localization"],
)
def test_no_tensor_of_the_loop_is_made_on_a_default_device(config, monkeypatch):
    # A tensor created without a device would be on the meta device.
    random = RandomizationConfig(
        link_mass=(0.9, 1.1), delay_steps=(0, 1), push_speed=(0.1, 0.2)
    )
    config = replace(config, task=replace(TASK, randomization=random))
    monkeypatch.setattr("egoskin.make.engine_of", lambda name: OnCpu)
    skin = config.skin.build(config.robot_config)
    sources = sparse_sources(config, skin)
    env = make_worker_env(config, skin, num_envs=8, seed=0, sparse=bool(sources))
    spec = PolicySpec.of(config, skin, TrainConfig().ppo.network, env, sources)
    agent = spec.build_agent(sources)
    ppo = PPO(agent, PPOConfig(num_mini_batches=2))
    env.reset()
    with torch.device("meta"):
        root = env.reset()
        rollout, root, infos = collect(env, agent, root, 40, ["terminated"], 0.5)
        metrics = ppo.update(rollout)
    assert root["observation"].device.type == "cpu"
    assert torch.stack([info["terminated"] for info in infos]).any()
    assert metrics["kl"] > 0


OF_RAYS = SensorConfig(coverage="ray", corruption="acoustic", reduce="min")


@pytest.mark.parametrize(
    ("config", "mask"),
    [
        (EnvConfig(), ("torso_link",)),
        (EnvConfig(sensor=OF_RAYS, history=3, previous_action=True), ()),
        (EnvConfig(sensor=SensorConfig(signal="localization", keep_last=True)), ()),
        (EnvConfig(sensor=SensorConfig(coverage="oracle"), history=2), ("all",)),
    ],
    ids=["field", "ray", "localization", "oracle"],
)
def test_all_specs_and_constants_are_on_the_device_of_the_environment(
    config, mask, monkeypatch
):
    # TorchRL compares the values of bounds; meta tensors have none.
    monkeypatch.setattr(torch, "allclose", lambda *args, **options: True)
    env = make_worker_env(config, num_envs=2, seed=0, mask=mask, device="meta")
    for spec in (env.observation_spec, env.input_spec, env.output_spec):
        for key, entry in spec.items(True, True):
            assert entry.device.type == "meta", key
    assert {x.device.type for x in env.fake_tensordict().values(True, True)} == {"meta"}
    constants = [*env.transform.buffers(), *env.transform.parameters()]
    assert all(x.device.type == "meta" for x in constants)


@pytest.mark.skipif(find_spec("mujoco_warp") is not None, reason="it is installed")
def test_an_engine_that_is_not_installed_is_refused_in_one_line(tmp_path):
    message = "engine warp needs mujoco_warp: `pip install 'egoskin[gpu]'`"
    for command in (("train", "--run-dir", tmp_path / "run"), ("evaluate", "blind")):
        done = call(*command, "--engine", "warp")
        assert done.returncode == 2
        assert message in " ".join(done.stderr.split())
    assert not list(tmp_path.iterdir())


def test_engines_say_what_they_cannot():
    assert engine_of("mujoco") is MujocoPhysics
    one = "engine warp simulates in one process: leave out num_workers, got 2"
    with pytest.raises(ValueError, match=one):
        TrainConfig(engine="warp", num_workers=2)
    TrainConfig(engine="warp", num_workers=1)
    with pytest.raises(ValueError, match=one):
        EvaluateConfig(policy=Path("blind"), engine="warp", num_workers=2)
    env = make_worker_env(EnvConfig(), num_envs=1, seed=0, device="meta")
    with pytest.raises(ValueError, match="engine mujoco simulates on the CPU"):
        env.base_env.check_scene()
