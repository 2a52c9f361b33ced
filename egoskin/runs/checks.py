"""Checks of a training before it has a folder, and before its workers start."""

from __future__ import annotations

from collections.abc import Mapping
from functools import reduce

import numpy as np
import torch
from torch import Tensor

from egoskin.agents.networks import Agent
from egoskin.make import check_env_memory, make_worker_env
from egoskin.policies.policy import (
    PolicySpec,
    agent_tensors,
    check_agent_tensors,
    sparse_sources,
)
from egoskin.robots.checks import check_trainable
from egoskin.runs.config import INIT_HASH, SKIN_HASH, TrainConfig, read_config
from egoskin.sensors import Skin
from egoskin.sensors.config import SensorConfig
from egoskin.storage.serialization import changed_fields, to_plain


def check_effect(sensor: SensorConfig, skin: Skin) -> None:
    """Raise ValueError if a skin file leaves an option of the sensors without effect.

    Args:
        sensor: The options.
        skin: The skin, as in its file.
    """
    if not sensor.uses_skin:
        return
    options, own = SensorConfig(), sensor.default_coverage
    text = "has no effect: the skin file sets the {} of each sensor"
    if (
        sensor.range != options.range
        and not np.isnan(skin.range).any()
        and (skin.range != sensor.range).any()
    ):
        raise ValueError(f"sensor.range={sensor.range:g} {text.format('range')}")
    if None in skin.coverage:
        return
    if sensor.coverage != options.coverage and not any(
        isinstance(each, type(own)) for each in skin.coverage
    ):
        raise ValueError(f"sensor.coverage={sensor.coverage} {text.format('type')}")
    if own != type(own)() and own not in skin.coverage:
        raise ValueError(f"sensor.{sensor.coverage} {text.format('type')}")


def check_repeats(config: TrainConfig, hashes: Mapping[str, str]) -> None:
    """Raise ValueError if the run to repeat had other files with the same options.

    Args:
        config: The training; `config.config` is the run to repeat, if any.
        hashes: Hashes of its skin and of the networks it starts from.
    """
    if config.config is None:
        return
    content, before = read_config(config.config)
    env, own = content["env"], to_plain(config.env)
    if (
        # Sensors are placed on the robot.
        all(env.get(name) == own[name] for name in ("robot", "skin"))
        and before.get(SKIN_HASH, hashes[SKIN_HASH]) != hashes[SKIN_HASH]
    ):
        raise ValueError(
            f"the skin differs from that of {config.config}: its file was changed, or "
            "sensors are placed differently here; use that run's skin: --skin.path "
            f"{config.config.parent / 'skin.json'}"
        )
    if content.get("init_from") == to_plain(config)["init_from"] and before.get(
        INIT_HASH
    ) != hashes.get(INIT_HASH):
        raise ValueError(
            f"{config.init_from} has changed since the run of {config.config} started "
            "from it"
        )


def check_fits(
    config: TrainConfig,
    skin: Skin,
    initial: tuple[dict[str, Tensor], PolicySpec] | None,
) -> None:
    """Raise ValueError unless the parts of a training fit together and into memory.

    Also if its robot cannot be trained.

    Args:
        config: The training.
        skin: Its sensors.
        initial: The networks to start from, as returned by `load_networks`.
    """
    check_trainable(config.env.robot_config)
    sources = sparse_sources(config.env, skin)
    one = make_worker_env(
        config.env, skin, num_envs=1, seed=config.seed, sparse=bool(sources)
    )
    spec = PolicySpec.of(config.env, skin, config.ppo.network, one, sources)
    with torch.device("meta"):
        agent = spec.build_agent()
    if initial is not None:
        _check_init(agent, spec, *initial, str(config.init_from))
    weights = sum(value.numel() for value in agent_tensors(agent).values())
    read = sum(size for key, size in spec.sizes.items() if key not in sources)
    others = {
        # Weights, two moments, and gradients in total and of four shares, in float32.
        "the networks (ppo.network.hidden)": 32 * weights,
        "a rollout (num_envs, ppo.rollout_steps, history)": 4
        * read
        * config.frames_per_batch,
    }
    if config.engine == "mujoco":
        check_env_memory(one, config.num_envs, others)


def _other_options(spec: PolicySpec, other: PolicySpec) -> str:
    """Return what the other policy was trained with, as text; "" if nothing differs."""
    before, now = (to_plain(s.env) for s in (other, spec))
    names = [n for n in changed_fields(before, now) if not n.startswith("task.")]
    values = (reduce(dict.__getitem__, name.split("."), before) for name in names)
    listed = ", ".join(f"{n} {v}" for n, v in zip(names, values, strict=True))
    return f"; it was trained with {listed}" if listed else ""


def _check_init(
    agent: Agent,
    spec: PolicySpec,
    tensors: Mapping[str, Tensor],
    other: PolicySpec,
    path: str,
) -> None:
    """Raise ValueError unless an agent can start from what `load_networks` returned."""
    robot, before = (s.env.robot_config for s in (spec, other))
    if robot.name != before.name:
        raise ValueError(f"{path} is a policy for {before.name}, not for {robot.name}")
    if robot.joints != before.joints:
        raise ValueError(
            f"{path} is a policy for a {robot.name} with other joints, or in another "
            f"order: {', '.join(before.joints)}; here: {', '.join(robot.joints)}"
        )
    if other.network.hidden != spec.network.hidden:
        raise ValueError(
            f"{path} has layers of {list(other.network.hidden)}, not of "
            f"{list(spec.network.hidden)} (ppo.network.hidden)"
        )
    if other.network.normalize != spec.network.normalize:
        raise ValueError(
            f"{path} was trained with ppo.network.normalize="
            f"{other.network.normalize}, not {spec.network.normalize}"
        )
    for key in {**spec.sizes, **other.sizes}:
        here, theirs = (s.sizes.get(key, 0) for s in (spec, other))
        if here != theirs:
            raise ValueError(
                f"{path} reads {theirs} values of {key!r}, but here there are {here}"
                + _other_options(spec, other)
            )
    signal, was = (s.env.sensor.signal for s in (spec, other))
    if spec.env.sensor.uses_skin and signal != was:
        raise ValueError(
            f"{path} reads the signal {was}, not {signal}: add --sensor.signal {was}"
        )
    check_agent_tensors(agent_tensors(agent), tensors, path)
