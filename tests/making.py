"""Untrained policies, for tests that apply to every policy, and a small run."""

from __future__ import annotations

from pathlib import Path

import torch

from egoskin.agents.networks import Agent, NetworkConfig
from egoskin.make import EnvConfig, make_worker_env
from egoskin.policies.policy import Policy, PolicySpec, sparse_sources
from egoskin.runs.config import TrainConfig
from egoskin.sensors.config import SensorConfig
from egoskin.storage.tensor_file import load_tensors, save_tensors


def make_agent(
    config: EnvConfig, network: NetworkConfig, seed: int = 0
) -> tuple[Agent, PolicySpec]:
    """Return an agent for an environment, with random weights and statistics."""
    skin = config.skin.build(config.robot_config)
    env = make_worker_env(config, skin, num_envs=1, seed=0)
    sources = sparse_sources(config, skin)
    spec = PolicySpec.of(config, skin, network, env, sources)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        agent = spec.build_agent(sources)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for weight in agent.parameters():
            noise = torch.randn(weight.shape, generator=generator)
            # As many inputs as there are, the sum is as large.
            weight += noise / max(weight.shape[-1], 1) ** 0.5
    for norm in agent.norms.values():
        norm.mean += torch.randn(norm.mean.shape, generator=generator)
        norm.var *= 0.1 + torch.rand(norm.var.shape, generator=generator)
    return agent, spec


def make_policy(
    config: EnvConfig, network: NetworkConfig | None = None, seed: int = 0
) -> Policy:
    """Return a policy for an environment, with random weights and statistics."""
    return Policy(*make_agent(config, network or NetworkConfig(), seed))


def remove_critic(policy: Path, out: Path) -> None:
    """Write a policy as older versions did, without its critic."""
    tensors, header = load_tensors(policy)
    actor = {n: v for n, v in tensors.items() if not n.startswith("agent/critic.")}
    assert len(actor) < len(tensors)
    save_tensors(out, actor, header)


def blind_run(path: Path, total_frames: int) -> TrainConfig:
    """Return a training without sensors, whose rollouts are 64 frames."""
    return TrainConfig(
        env=EnvConfig(sensor=SensorConfig(coverage="none")),
        run_dir=path,
        num_envs=4,
        num_workers=1,
        total_frames=total_frames,
    )
