"""Actor and critic networks.

Each network reads a *list* of keys. Their tensors are never concatenated: the first
layer is the sum of one linear map per key, which equals a linear map of the
concatenation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import InteractionType, TensorDictModule
from torch import Tensor, nn
from torchrl.modules import IndependentNormal, ProbabilisticActor

from egoskin.agents.normalizers import RunningNorm, SignalNorm
from egoskin.bounds import POSITIVE, Interval, check_bounds
from egoskin.sparse import SparseRows, SparseSource

# Key of the skin's signals.
_SIGNAL = "signal"


@dataclass(frozen=True, kw_only=True)
class NetworkConfig:
    """Size and initialisation of actor and critic."""

    hidden: Annotated[tuple[int, ...], Interval(ge=1, le=4096)] = (32, 32)
    """Units of the hidden layers, the same for actor and critic."""
    init_std: Annotated[float, POSITIVE] = 0.8
    """Initial standard deviation of the action."""
    std_bounds: Annotated[tuple[float, float], POSITIVE] = (0.1, 1.0)
    """Lower and upper bound of the standard deviation."""
    normalize: Literal["body", "all"] = "all"
    """Running normalisation of all inputs except the skin's signals, or of all inputs.
    Signals share one mean and deviation, which keeps differences between sensors; their
    total weight does not depend on their number."""

    def __post_init__(self) -> None:
        """Raise ValueError for invalid sizes or bounds."""
        check_bounds(self)
        low, high = self.std_bounds
        if not low <= self.init_std <= high:
            raise ValueError(
                "need std_bounds[0] <= init_std <= std_bounds[1], got init_std "
                f"{self.init_std} and std_bounds ({low}, {high})"
            )
        if not self.hidden:
            raise ValueError("hidden needs at least one layer size, got none")


class KeyedMLP(nn.Module):
    """A multilayer perceptron with ELU whose input consists of several tensors.

    Args:
        sizes: Features of each input.
        hidden: Units of the hidden layers.
        out: Number of outputs.
        out_gain: Gain of the orthogonal initialisation of the last layer.
    """

    def __init__(
        self, sizes: Sequence[int], hidden: Sequence[int], out: int, out_gain: float
    ) -> None:
        super().__init__()
        # One orthogonal matrix for all inputs, as for their concatenation.
        joined = torch.empty(hidden[0], sum(sizes))
        nn.init.orthogonal_(joined, gain=2**0.5)
        inputs = [nn.Linear(n, hidden[0], bias=i == 0) for i, n in enumerate(sizes)]
        for linear, part in zip(inputs, joined.split(list(sizes), 1), strict=True):
            linear.weight.data.copy_(part)
        nn.init.zeros_(inputs[0].bias)
        self.inputs = nn.ModuleList(inputs)
        layers: list[nn.Module] = [nn.ELU()]
        for before, after in zip(hidden, hidden[1:], strict=False):
            layers += [_orthogonal(before, after, 2**0.5), nn.ELU()]
        layers.append(_orthogonal(hidden[-1], out, out_gain))
        self.tail = nn.Sequential(*layers)

    def forward(self, *inputs: Tensor | SparseRows) -> Tensor:
        """Return the outputs, ``[*B, out]``, given each input as ``[*B, size]``."""
        first, *others = (
            _apply(layer, x) for x, layer in zip(inputs, self.inputs, strict=True)
        )
        return self.tail(sum(others, start=first))


def _apply(layer: nn.Module, x: Tensor | SparseRows) -> Tensor:
    """Return the output of a linear layer for dense or sparse features."""
    assert isinstance(layer, nn.Linear)
    if isinstance(x, SparseRows):
        return x.linear(layer.weight, layer.bias)
    return layer(x)


def _orthogonal(before: int, after: int, gain: float) -> nn.Linear:
    layer = nn.Linear(before, after)
    nn.init.orthogonal_(layer.weight, gain=gain)
    nn.init.zeros_(layer.bias)
    return layer


class GaussianHead(nn.Module):
    """Mean from a network, standard deviation from a bounded parameter.

    Args:
        body: Network of the mean.
        size: Number of actions.
        init_std: Initial standard deviation.
        std_bounds: Bounds of the standard deviation.
    """

    def __init__(
        self,
        body: KeyedMLP,
        size: int,
        init_std: float,
        std_bounds: tuple[float, float],
    ) -> None:
        super().__init__()
        self.body = body
        self.log_std = nn.Parameter(torch.full((size,), init_std).log())
        self._bounds = tuple(torch.tensor(std_bounds, device="cpu").log().tolist())

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return (loc, scale), ``[*B, J]`` each."""
        loc = self.body(*inputs)
        return loc, self.log_std.exp().expand_as(loc)

    @torch.no_grad()
    def bound_std(self) -> None:
        """Clamp the standard deviation to its bounds; called after each step."""
        self.log_std.clamp_(*self._bounds)


class SharedStdNormal(IndependentNormal):
    """Independent Gaussians whose standard deviations are the same in every row.

    Logarithms and reciprocals are computed for one row only, which saves a tenth of the
    time of an update.
    """

    def _row(self) -> Tensor:
        scale = self.base_dist.scale
        return scale.reshape(-1, scale.shape[-1])[0]

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-density ``[*B]`` of actions ``[*B, J]``."""
        row = self._row()
        # log p = -|(a - loc) / std|^2 / 2 - sum log std - J log(2 pi) / 2
        z = (value - self.base_dist.loc) * row.reciprocal()
        constant = row.log().sum() + 0.5 * math.log(2 * math.pi) * len(row)
        return -0.5 * z.square().sum(-1) - constant

    def entropy(self) -> Tensor:
        """Return the entropy, ``[*B]``."""
        row = self._row()
        each = row.log().sum() + 0.5 * math.log(2 * math.pi * math.e) * len(row)
        return each.expand(self.batch_shape)


class Agent(nn.Module):
    """Actor, critic and the normalisers of their inputs.

    `sense` returns the features, and `encode` normalises each key of them to
    ``("inputs", key)``, once for both networks and for all passes over a rollout. From
    the inputs of ``actor_keys`` the actor writes ``loc``, ``scale``, ``action``,
    ``action_log_prob``; from those of ``critic_keys`` the critic writes
    ``state_value``.

    Args:
        sizes: Number of features of each key.
        actor_keys: Keys that the actor reads.
        critic_keys: Keys that the critic reads.
        num_actions: ``J``.
        config: Size and initialisation.
        sources: Sparse sources of the keys that the environment does not output.
    """

    def __init__(
        self,
        sizes: Mapping[str, int],
        actor_keys: Sequence[str],
        critic_keys: Sequence[str],
        num_actions: int,
        config: NetworkConfig,
        sources: Mapping[str, SparseSource] | None = None,
    ) -> None:
        super().__init__()
        self.sources = dict(sources or {})
        self.actor_keys, self.critic_keys = list(actor_keys), list(critic_keys)
        self.norms = nn.ModuleDict(
            {
                key: (SignalNorm if key == _SIGNAL else RunningNorm)(sizes[key])
                for key in critic_keys
                if config.normalize == "all" or key != _SIGNAL
            }
        )

        def network(keys: Sequence[str], out: int, gain: float) -> KeyedMLP:
            return KeyedMLP([sizes[k] for k in keys], config.hidden, out, gain)

        # A small last layer keeps the first actions near the default pose.
        self.head = GaussianHead(
            network(actor_keys, num_actions, 0.01),
            num_actions,
            config.init_std,
            config.std_bounds,
        )
        self.actor = ProbabilisticActor(
            TensorDictModule(
                self.head, in_keys=input_keys(actor_keys), out_keys=["loc", "scale"]
            ),
            in_keys=["loc", "scale"],
            out_keys=["action"],
            distribution_class=SharedStdNormal,
            # TorchRL's default is the mean, which does not explore.
            default_interaction_type=InteractionType.RANDOM,
            # The check of all values at every call is slow and never fails here.
            distribution_kwargs={"validate_args": False},
            return_log_prob=True,
            log_prob_key="action_log_prob",
        )
        self.critic = TensorDictModule(
            network(critic_keys, 1, 1.0),
            in_keys=input_keys(critic_keys),
            out_keys=["state_value"],
        )

    @property
    def read_keys(self) -> list[str]:
        """Keys of the environment's output that `sense` reads."""
        reads = {key: source.in_keys for key, source in self.sources.items()}
        return list(
            dict.fromkeys(r for key in self.critic_keys for r in reads.get(key, [key]))
        )

    def sense(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the features that the networks read, by key, not normalised.

        Args:
            tensordict: Contains ``read_keys``, ``[B]``.
        """
        given = [key for key in self.critic_keys if key not in self.sources]
        features = TensorDict(
            {key: tensordict[key] for key in given},
            batch_size=tensordict.batch_size,
            device=tensordict.device,
        )
        for key, source in self.sources.items():
            features.set_non_tensor(key, source(tensordict))
        return features

    def encode(self, features: TensorDictBase) -> TensorDict:
        """Return the normalised network inputs, under ``("inputs", key)``.

        Args:
            features: Result of `sense`, or the part that the actor needs, ``[B]``.
        """
        inputs = TensorDict(batch_size=features.batch_size, device=features.device)
        for key in (k for k in self.critic_keys if k in features.keys()):
            value, norm = features[key], self.norms[key] if key in self.norms else None
            if isinstance(value, SparseRows):
                if isinstance(norm, SignalNorm):
                    value = norm.sparse(value)
                inputs.set_non_tensor(key, value)
            else:
                inputs[key] = value if norm is None else norm(value)
        return TensorDict(
            {"inputs": inputs}, features.batch_size, device=features.device
        )


def input_keys(keys: Sequence[str]) -> list[NestedKey]:
    """Return the keys under which `Agent.encode` writes the network inputs."""
    return [("inputs", key) for key in keys]
