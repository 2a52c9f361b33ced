"""Touch: contacts of links, and contact penalty, termination and labels for tasks.

Contacts are per link, ``[*B, L]``; shell patterns select which of the ``L`` links
count. For a walking task, exclude the feet::

    body = [name for name in robot.links if name not in robot.feet]
    ContactTermination(robot.links, body)

`ContactPenalty` and `ContactTermination` read and overwrite TorchRL's reward and done
keys, as `torchrl.envs.RewardScaling` does.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

from egoskin.hints import matching
from egoskin.transform import RowTransform, StatefulTransform


def _matching(links: Sequence[str], patterns: Sequence[str]) -> Tensor:
    """Return which links match any of the patterns, ``[L]`` bool.

    Raises:
        ValueError: If a pattern matches no link.
    """
    found = matching(patterns, links, "link")
    return torch.tensor([name in found for name in links], dtype=torch.bool)


def _check_links(tactile: Tensor, links: Tensor, key: NestedKey) -> None:
    """Raise ValueError unless there is one contact for each link."""
    if tactile.shape[-1] != len(links):
        raise ValueError(
            f"{key!r} holds {tactile.shape[-1]} contacts per row, but the transform "
            f"was made for {len(links)} links"
        )


class Tactile(RowTransform):
    """Whether the contact force on each link is above a threshold.

    Reads ``contact_force [*B, L, n]`` [N], n >= 3; writes ``tactile [*B, L]`` bool. The
    last three components are the force, so MuJoCo's ``cfrc_ext`` (torque, then force)
    can be used directly. A force of NaN counts as contact.

    Args:
        threshold: A link is in contact if its force is larger than this [N].
        in_keys: Key of the forces.
        out_keys: Key of the contacts.

    Raises:
        ValueError: If the threshold is negative or NaN.
    """

    _NUM_IN = _NUM_OUT = (1, 1)

    def __init__(
        self,
        threshold: float,
        in_keys: Sequence[NestedKey] = ("contact_force",),
        out_keys: Sequence[NestedKey] = ("tactile",),
    ) -> None:
        super().__init__(in_keys, out_keys)
        if not threshold >= 0:
            raise ValueError(f"threshold must not be negative, got {threshold}")
        self.threshold = float(threshold)

    def compute(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return the contacts, ``[B, L]`` bool.

        Raises:
            ValueError: If the forces are not vectors.
        """
        (force,) = inputs
        if force.ndim < 3 or force.shape[-1] < 3:
            raise ValueError(
                f"{self.in_keys[0]!r} must be [*B, L, n], n >= 3, the last three "
                f"components the force; got {list(force.shape[1:])} after the batch"
            )
        # Not `>`, which is false for NaN: a diverged simulation must count as contact.
        return (~(force[..., -3:].norm(dim=-1) <= self.threshold),)


class ContactPenalty(Transform):
    """Reduces the reward by a price for each link in contact.

    Reads ``tactile [*B, L]`` and ``reward [*B, 1]``; writes ``reward``.

    Args:
        links: Names of the links, in the order of ``tactile``.
        prices: Cost of one step of contact by link name pattern. The prices of all
            patterns that match a link add up; a link without a match costs nothing.
        in_keys: Keys of the two inputs, in the order above.
        out_keys: Key of the reward.

    Raises:
        ValueError: If a pattern matches no link, a price is not finite or ``prices`` is
            empty.
    """

    _prices: Tensor

    def __init__(
        self,
        links: Sequence[str],
        prices: Mapping[str, float],
        in_keys: Sequence[NestedKey] = ("tactile", "reward"),
        out_keys: Sequence[NestedKey] = ("reward",),
    ) -> None:
        super().__init__(in_keys=list(in_keys), out_keys=list(out_keys))
        if not prices or not all(map(math.isfinite, prices.values())):
            raise ValueError(f"prices must be finite and not empty, got {prices}")
        parts = [price * _matching(links, [p]) for p, price in prices.items()]
        self.register_buffer("_prices", torch.stack(parts).sum(0), persistent=False)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        tactile, reward = (next_tensordict[key] for key in self.in_keys)
        _check_links(tactile, self._prices, self.in_keys[0])
        cost = tactile.to(reward.dtype) @ self._prices.to(reward.dtype)
        return next_tensordict.set(self.out_keys[0], reward - cost[..., None])

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the reward into any tensordict that holds the in keys."""
        return self._call(tensordict)

    def transform_reward_spec(self, reward_spec: TensorSpec) -> TensorSpec:
        """Return the spec with an unbounded reward."""
        assert isinstance(reward_spec, Composite)
        old = reward_spec[self.in_keys[1]]
        reward_spec[self.out_keys[0]] = Unbounded(
            shape=old.shape, dtype=old.dtype, device=old.device
        )
        return reward_spec


class ContactTermination(Transform):
    """Terminates the episode when a link is in contact.

    Reads ``tactile [*B, L]``, ``terminated [*B, 1]`` and ``done [*B, 1]``; writes
    ``terminated`` and ``done``; ``truncated`` is unchanged. A contact in the state
    after a reset does not end the episode.

    Args:
        links: Names of the links, in the order of ``tactile``.
        counted: Name patterns of the links whose contact ends the episode.
        in_keys: Keys of the three inputs, in the order above.
        out_keys: Keys of the two outputs, in the order above.

    Raises:
        ValueError: If a pattern matches no link.
    """

    _counted: Tensor

    def __init__(
        self,
        links: Sequence[str],
        counted: Sequence[str] = ("*",),
        in_keys: Sequence[NestedKey] = ("tactile", "terminated", "done"),
        out_keys: Sequence[NestedKey] = ("terminated", "done"),
    ) -> None:
        super().__init__(in_keys=list(in_keys), out_keys=list(out_keys))
        self.register_buffer("_counted", _matching(links, counted), persistent=False)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        tactile, *ends = (next_tensordict[key] for key in self.in_keys)
        _check_links(tactile, self._counted, self.in_keys[0])
        touched = torch.any(tactile & self._counted, -1, keepdim=True)
        for key, end in zip(self.out_keys, ends, strict=True):
            next_tensordict.set(key, end | touched)
        return next_tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the done flags into any tensordict that holds the in keys."""
        return self._call(tensordict)


class ContactFree(StatefulTransform):
    """Whether the trajectory has been free of contact so far.

    Reads ``tactile [*B, L]``; writes ``contact_free [*B, 1]`` bool, which is its
    state. At the last step of a trajectory it equals the label that `contact_free`
    gives to the whole trajectory, except that contact in the state after the reset
    counts only here: `contact_free` sees only steps.

    Args:
        links: Names of the links, in the order of ``tactile``.
        counted: Name patterns of the links whose contact counts.
        in_keys: Key of the contacts.
        out_keys: Key of the label.

    Raises:
        ValueError: If a pattern matches no link.
    """

    _NUM_IN = _NUM_OUT = (1, 1)
    _counted: Tensor

    def __init__(
        self,
        links: Sequence[str],
        counted: Sequence[str] = ("*",),
        in_keys: Sequence[NestedKey] = ("tactile",),
        out_keys: Sequence[NestedKey] = ("contact_free",),
    ) -> None:
        super().__init__(in_keys, out_keys, state_keys=out_keys)
        self.register_buffer("_counted", _matching(links, counted), persistent=False)

    def start(
        self,
        rows: Tensor,
        inputs: Sequence[Tensor],
        before: Sequence[Tensor] | None,
    ) -> Sequence[Tensor]:
        """Return whether the first state is free of contact, ``[B, 1]``."""
        (tactile,) = inputs
        _check_links(tactile, self._counted, self.in_keys[0])
        return (~(tactile & self._counted).any(-1, keepdim=True),)

    def advance(
        self, rows: Tensor, inputs: Sequence[Tensor], state: Sequence[Tensor]
    ) -> Sequence[Tensor]:
        """Return whether the trajectory is still free of contact, ``[B, 1]``."""
        (now,) = self.start(rows, inputs, None)
        return (state[0] & now,)


def _trajectory(done: Tensor) -> Tensor:
    """Return the index of each step's trajectory: the number of ends before it."""
    return done.long().cumsum(-2) - done.long()


def contact_free(tactile: Tensor, done: Tensor) -> Tensor:
    """Return whether the whole trajectory that each step belongs to is contact-free.

    Args:
        tactile: Contacts after each step, ``[*B, T, L]`` bool; pass only the links
            that count (without feet: ``tactile[..., body]``).
        done: Whether the step was the last of its trajectory, ``[*B, T, 1]`` bool. An
            unfinished last trajectory is labelled by the steps it has.

    Returns:
        One label for each step, ``[*B, T, 1]`` bool.
    """
    trajectory = _trajectory(done)
    touched = tactile.any(-1, keepdim=True).long()
    contacts = torch.zeros_like(trajectory).scatter_add_(-2, trajectory, touched)
    return contacts.gather(-2, trajectory) == 0


def split_by_contact(
    data: TensorDictBase, tactile: Tensor, done: Tensor
) -> tuple[list[TensorDictBase], list[TensorDictBase]]:
    """Split stored steps into contact-free trajectories and others.

    Args:
        data: Steps ``[*B, T]``.
        tactile: As for `contact_free`.
        done: As for `contact_free`.

    Returns:
        Contact-free trajectories and others: two lists of tensordicts ``[T_i]`` in the
        order of the data, which are views if the data is contiguous.
    """
    flat = data.reshape(-1)
    number = _trajectory(done).reshape(-1, data.shape[-1])
    # A row of T steps has at most T trajectories, so the numbers are unique.
    row = torch.arange(len(number), device=number.device)
    number = number + data.shape[-1] * row[:, None]
    _, lengths = number.reshape(-1).unique_consecutive(return_counts=True)
    # The label of a trajectory is that of its last step.
    free = contact_free(tactile, done).reshape(-1)[lengths.cumsum(0) - 1]
    pieces = list(zip(flat.split(lengths.tolist()), free.tolist(), strict=True))
    return [p for p, ok in pieces if ok], [p for p, ok in pieces if not ok]
