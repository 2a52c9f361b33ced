"""Trained policies as self-contained files.

A policy file contains weights, normaliser, skin, sensor and task. A checkpoint of a run
contains the same and more, and is read in the same way. Some policies come with the
package.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path
from shlex import quote
from typing import Any, get_args

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor, nn
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase

from egoskin.agents.networks import Agent, NetworkConfig
from egoskin.envs.physics import Engine
from egoskin.make import EnvConfig
from egoskin.sensors import Skin
from egoskin.sparse import SparseSource
from egoskin.storage.serialization import from_plain, to_plain
from egoskin.storage.tensor_file import load_tensors, part, prefixed, save_tensors

CHECKPOINT_NAME = "checkpoint.safetensors"
"""Name of the latest checkpoint in a run folder."""
# Prefix of the critic's tensors, which policy files of older versions lack.
_CRITIC = "critic."
# Signals that are not normalised are in metres, or fractions of the range.
_LARGEST_SIGNAL = 1e6
_SHIPPED = Path(__file__).parents[1] / "assets" / "policies"


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PolicySpec:
    """Everything needed to build an agent and its environment."""

    env: EnvConfig
    """Robot, task, sensors."""
    skin: Skin
    """The sensors of the skin."""
    network: NetworkConfig
    """Size of the networks."""
    sizes: Mapping[str, int]
    """Number of features of each key that the networks read."""
    num_actions: int
    """Number of actions ``J``."""
    frames: int = 0
    """Number of environment steps of the training."""
    engine: Engine = "mujoco"
    """Physics engine used in training."""

    @classmethod
    def of(
        cls,
        config: EnvConfig,
        skin: Skin,
        network: NetworkConfig,
        env: EnvBase,
        sources: Mapping[str, SparseSource],
    ) -> PolicySpec:
        """Return the specification for an environment.

        Args:
            config: Configuration of the environment.
            skin: Skin of the environment.
            network: Size of the networks.
            env: The environment.
            sources: Sparse sources of the keys that it does not output.
        """
        spec = env.observation_spec
        return cls(
            env=config,
            skin=skin,
            network=network,
            sizes={
                key: sources[key].size if key in sources else spec[key].shape[-1]
                for key in config.critic_keys
            },
            num_actions=env.action_spec.shape[-1],
        )

    def build_agent(self, sources: Mapping[str, SparseSource] | None = None) -> Agent:
        """Return a fresh agent.

        Args:
            sources: Sparse sources of the keys that its environment does not output.
        """
        default = torch.get_default_dtype()
        # The environments are float32 whatever the default of the user's program is.
        torch.set_default_dtype(torch.float32)
        try:
            return Agent(
                self.sizes,
                self.env.actor_keys,
                self.env.critic_keys,
                self.num_actions,
                self.network,
                sources,
            )
        finally:
            torch.set_default_dtype(default)

    def check_claims(self, tensors: Mapping[str, Tensor], what: str) -> None:
        """Raise ValueError unless tensors match an agent with these sizes.

        The agent is not allocated, so wrong sizes cannot exhaust the memory.

        Args:
            tensors: Tensors of the file that holds the specification.
            what: Name of the file.
        """
        hidden = self.network.hidden
        claims = [*self.sizes.values(), self.num_actions, *hidden, len(hidden)]
        held = sum(value.numel() for value in tensors.values())
        for claim in claims:
            if not 0 < claim <= held:
                raise ValueError(
                    f"{what} is damaged: its header claims a size of {claim}, but it "
                    f"holds {held} numbers"
                )
        with torch.device("meta"):
            check_agent_tensors(agent_tensors(self.build_agent()), tensors, what)

    def header(self) -> dict[str, Any]:
        """Return the specification as JSON values."""
        return {
            "standard": self.env.standard,
            "env": to_plain(self.env),
            "skin": self.skin.to_dict(),
            "network": to_plain(self.network),
            "sizes": dict(self.sizes),
            "num_actions": self.num_actions,
            "frames": self.frames,
            "engine": self.engine,
        }

    @classmethod
    def from_header(cls, header: Mapping[str, Any], what: str) -> PolicySpec:
        """Return the specification from the result of `header`.

        Raises:
            ValueError: If the header is not valid.
        """
        if not isinstance(header, Mapping):
            raise ValueError(f"{what} is not a policy: it must be an object")
        missing = [f.name for f in dataclasses.fields(cls) if f.name not in header]
        if missing:
            raise ValueError(f"{what} is not a policy: {missing[0]!r} is missing")
        sizes = header["sizes"]
        numbers = sizes.values() if isinstance(sizes, dict) else [None]
        numbers = [*numbers, header["num_actions"], header["frames"]]
        if not all(isinstance(number, int) for number in numbers):
            raise ValueError(
                f"{what} is not a policy: sizes, num_actions and frames must be whole "
                "numbers"
            )
        if header["engine"] not in get_args(Engine):
            raise ValueError(f"{what} is not a policy: no engine {header['engine']!r}")
        env = from_plain(EnvConfig, header["env"], what)
        if lacking := set(env.critic_keys) - sizes.keys():
            raise ValueError(f"{what} is not a policy: no size for {min(lacking)!r}")
        try:
            skin = Skin.from_dict(header["skin"])
        except ValueError as error:
            raise ValueError(f"{what} is not a policy: {error}") from error
        return cls(
            env=env,
            skin=skin,
            network=from_plain(NetworkConfig, header["network"], what),
            sizes=sizes,
            num_actions=header["num_actions"],
            frames=header["frames"],
            engine=header["engine"],
        )


def sparse_sources(config: EnvConfig, skin: Skin) -> dict[str, SparseSource]:
    """Return the sources of the keys that are used in sparse form in training.

    Args:
        config: Configuration of the environment.
        skin: The sensors.
    """
    if config.history > 1:
        return {}
    rays = config.pipeline(skin).sparse_rays(config.task.throws.balls)
    return {} if rays is None else {"signal": rays}


def agent_tensors(agent: Agent) -> dict[str, Tensor]:
    """Return all parameters and buffers of an agent by name."""
    return {**dict(agent.named_parameters()), **dict(agent.named_buffers())}


def has_critic(tensors: Iterable[str]) -> bool:
    """Return whether tensors of an agent, by name, include those of its critic."""
    return any(name.startswith(_CRITIC) for name in tensors)


def check_agent_tensors(
    own: Mapping[str, Tensor], tensors: Mapping[str, Tensor], what: str
) -> None:
    """Raise ValueError unless tensors match an agent, with or without its critic.

    Args:
        own: Result of `agent_tensors` for the agent.
        tensors: Tensors to load.
        what: Origin of the tensors, for the error text, which names the tensor.
    """
    missing = own.keys() - tensors.keys()
    if not has_critic(tensors):
        missing = {name for name in missing if not name.startswith(_CRITIC)}
    if missing:
        raise ValueError(f"{what}: tensor {min(missing)!r} of the networks is missing")
    check_like(own, tensors, what)


def check_like(
    own: Mapping[str, Tensor], tensors: Mapping[str, Tensor], what: str
) -> None:
    """Raise ValueError if a tensor is unknown or has another shape or type."""
    for name, value in tensors.items():
        if name not in own:
            raise ValueError(f"{what}: unknown tensor {name!r}")
        if (own[name].shape, own[name].dtype) != (value.shape, value.dtype):
            raise ValueError(
                f"{what}: tensor {name!r} does not fit: expected {_kind(own[name])}, "
                f"got {_kind(value)}"
            )


def _kind(value: Tensor) -> str:
    return f"{list(value.shape)} of {str(value.dtype).removeprefix('torch.')}"


@torch.no_grad()
def load_agent_tensors(agent: Agent, tensors: Mapping[str, Tensor], what: str) -> None:
    """Copy tensors into an agent; the critic is unchanged if they do not include it.

    Raises:
        ValueError: If a name, shape or type does not match, or a tensor is missing; the
            agent is then unchanged.
    """
    own = agent_tensors(agent)
    check_agent_tensors(own, tensors, what)
    for name, value in tensors.items():
        own[name].copy_(value)


@torch.no_grad()
def check_finite(agent: Agent, what: str) -> None:
    """Raise ValueError if an agent could output an action that is not finite.

    Args:
        agent: The agent, loaded.
        what: Origin of the agent, for the error text.
    """
    for name, value in agent_tensors(agent).items():
        # Computations use float32, whatever the stored type.
        if not value.float().isfinite().all():
            raise ValueError(f"{what} is damaged: tensor {name!r} is not finite")
        if name.endswith(".var") and (value < 0).any():
            raise ValueError(f"{what} is damaged: tensor {name!r} is negative")
    # The sum of the magnitudes, with all inputs at their maximum, bounds every sum.
    body = copy.deepcopy(agent.head.body)
    for weight in body.parameters():
        weight.abs_()
    largest = []
    for key, layer in zip(agent.actor_keys, body.inputs, strict=True):
        assert isinstance(layer, nn.Linear)
        x = layer.weight.new_full((1, layer.in_features), _LARGEST_SIGNAL)
        if key in agent.norms:
            x = agent.norms[key](x.fill_(torch.finfo(x.dtype).max))
        largest.append(x)
    scale = agent.head.log_std.exp()
    if not (body(*largest).isfinite().all() and scale.isfinite().all()):
        raise ValueError(
            f"{what} is damaged: its weights are so large that actions may not be "
            "finite"
        )


def save_policy(path: Path, agent: Agent, spec: PolicySpec) -> None:
    """Write an agent as a self-contained policy file.

    The critic is included, so that the policy can be trained further.
    """
    save_tensors(
        path, prefixed("agent", agent_tensors(agent)), {"policy": spec.header()}
    )


class Policy(TensorDictModuleBase):
    """A trained actor that writes its mean action.

    It is a regular TensorDict module, usable with ``env.rollout``, TorchRL collectors,
    ``TensorDictSequential``, `torch.compile` and `torch.vmap`. When called with the
    tensors of ``in_keys``, in that order, it returns the action.

    Args:
        agent: Agent whose actor is used; its parameters no longer require gradients.
        policy_spec: Specification of the agent and its environment.
    """

    def __init__(self, agent: Agent, policy_spec: PolicySpec) -> None:
        super().__init__()
        self.policy_spec = policy_spec
        self.in_keys, self.out_keys = agent.actor_keys, ["action"]
        self.head = agent.head.requires_grad_(False)
        """Network that outputs the action distribution."""
        self.norms = nn.ModuleDict(
            {key: agent.norms[key] for key in agent.actor_keys if key in agent.norms}
        )
        """Normaliser of each of ``in_keys`` that has one."""

    @property
    def env_config(self) -> EnvConfig:
        """Robot, task and sensors the policy was trained with."""
        return self.policy_spec.env

    @property
    def skin(self) -> Skin:
        """The skin the policy was trained with."""
        return self.policy_spec.skin

    @property
    def spec(self) -> Composite:
        """TorchRL spec of the output."""
        weight = self.head.log_std
        return Composite(
            action=Unbounded(weight.shape, device=weight.device, dtype=weight.dtype)
        )

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action [*B, J]`` from ``in_keys``, ``[*B, F]`` of any float dtype.

        The batch may have any number of dimensions, or none. The action has the dtype
        of the policy's parameters.

        Raises:
            KeyError: If a key is missing; the text names the required keys.
            ValueError: If a key has another number of features than in training.
        """
        return tensordict.set("action", self._mean(tensordict))

    def _mean(self, tensordict: TensorDictBase) -> Tensor:
        """Return the mean action, ``[*B, J]``."""
        keys, inputs = self.env_config.actor_keys, []
        for key in keys:
            value, size = tensordict.get(key, None), self.policy_spec.sizes[key]
            if value is None:
                raise KeyError(
                    f"the policy reads {', '.join(keys)}; {key!r} is missing"
                )
            if value.shape[-1:] != (size,):
                raise ValueError(
                    f"the policy was trained with {key!r} [*B, {size}], got "
                    f"{list(value.shape)}: is it the environment of "
                    "make_env(policy.env_config, policy.skin)?"
                )
            value = value.to(self.head.log_std.dtype)
            inputs.append(self.norms[key](value) if key in self.norms else value)
        return self.head(*inputs)[0]


class Critic(TensorDictModuleBase):
    """A trained critic that writes the value of the state, ``state_value [*B, 1]``.

    Args:
        agent: Agent whose critic is used; its parameters no longer require gradients.
    """

    def __init__(self, agent: Agent) -> None:
        super().__init__()
        self.in_keys, self.out_keys = agent.critic_keys, ["state_value"]
        self._agent = agent.requires_grad_(False)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``state_value [B, 1]`` from ``in_keys``, ``[B, F]`` each."""
        inputs = self._agent.encode(self._agent.sense(tensordict))
        value = self._agent.critic(inputs)["state_value"]
        return tensordict.set("state_value", value)


def shipped_policies() -> list[str]:
    """Return the names of the policies that come with the package."""
    return sorted(path.stem for path in _SHIPPED.glob("*.safetensors"))


def load_policy(path: str | Path) -> Policy:
    """Return the policy of a policy file, a checkpoint, a run folder or a name.

    Args:
        path: A file, a run folder (for its latest checkpoint) or, if there is no such
            path, one of `shipped_policies`.

    Returns:
        A module that reads `Policy.in_keys` of a TensorDict and writes the mean
        ``action``. `Policy.env_config` and `Policy.skin` hold its environment and skin.

    Raises:
        ValueError: If there is no policy; the text says why.
    """
    agent, spec, _ = _load_agent(policy_file(path))
    return Policy(agent, spec)


def load_with_critic(path: str | Path) -> tuple[Policy, Critic | None]:
    """Return a policy and the critic that was trained with it.

    The critic is None in a policy file of an older version, which has none.

    Args:
        path: As in `load_policy`.

    Raises:
        ValueError: If there is no policy; the text says why.
    """
    agent, spec, complete = _load_agent(policy_file(path))
    return Policy(agent, spec), Critic(agent) if complete else None


def load_networks(path: str | Path) -> tuple[dict[str, Tensor], PolicySpec]:
    """Return the networks and normalisers of a policy or run, to train them further.

    Args:
        path: As in `load_policy`.

    Returns:
        Tensors for `load_agent_tensors`, and the specification of their agent. Policy
        files of older versions have no critic.

    Raises:
        ValueError: As in `load_policy`.
    """
    agent, spec, complete = _load_agent(policy_file(path))
    tensors = {
        name: value.detach()
        for name, value in agent_tensors(agent).items()
        if complete or not name.startswith(_CRITIC)
    }
    return tensors, spec


def policy_file(path: str | Path) -> Path:
    """Return the file that `load_policy` reads.

    Raises:
        ValueError: If there is no such file; the text says why.
    """
    path = Path(path)
    if not path.exists():
        names = shipped_policies()
        if str(path) not in names:
            raise ValueError(
                f"no policy {path}: not a file, a folder or one that comes with "
                f"the package ({', '.join(names)})"
            )
        path = _SHIPPED / f"{path}.safetensors"
    if path.is_dir():
        if not (path / CHECKPOINT_NAME).is_file():
            raise ValueError(_no_checkpoint(path))
        path = path / CHECKPOINT_NAME
    return path


def _no_checkpoint(folder: Path) -> str:
    """Return why a folder has no checkpoint, as the text of an error."""
    if policies := sorted((folder / "policies").glob("*.safetensors")):
        return f"{folder} has no checkpoint; its latest policy is {policies[-1]}"
    if (folder / "config.json").is_file():
        resume = f"egoskin train --resume {quote(str(folder))}"
        return (
            f"{folder} has no checkpoint yet: its training is starting, or was stopped "
            f"before the first (continue with: {resume})"
        )
    return f"{folder} is not a run folder: it has no {CHECKPOINT_NAME}"


def _load_agent(path: Path) -> tuple[Agent, PolicySpec, bool]:
    """Return the agent of a file, its specification, and whether it has a critic."""
    tensors, header = load_tensors(path)
    spec = PolicySpec.from_header(header.get("policy", {}), str(path))
    own = part("agent", tensors)
    spec.check_claims(own, str(path))
    agent = spec.build_agent()
    load_agent_tensors(agent, own, str(path))
    check_finite(agent, str(path))
    return agent, spec, has_critic(own)
