"""Keys of the environment's output at every step, each declared once, in `STATE`.

Contract: a key is a row of the table and a line of `DodgeballEnv` that computes it. Its
spec, its value at the start of an episode, whether it leaves the worker, and its entry
in the documentation are derived from the row.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torchrl.data import Binary, Composite, TensorSpec, Unbounded

Reader = Literal["sensors", "observations", "trainer", "evaluation"]
"""Reader of a key: ``sensors`` and ``observations``, transforms in the worker; or
``trainer`` and ``evaluation``, metrics of training and of a throw set in the parent
process. Code beside the environment (behaviour, films) is not listed: it reads all."""
_FLAG, _COUNT, _NUMBER = torch.bool, torch.int64, torch.float32


@dataclass(frozen=True)
class StateKey:
    """One key of the environment's output, other than reward and done flags."""

    name: str
    """The key."""
    shape: tuple[int | str, ...]
    """Shape of a row; ``J`` joints, ``L`` links, ``O`` objects, ``R`` reward terms."""
    content: str
    """Description, with units."""
    read_by: tuple[Reader, ...]
    """Readers of the key."""
    dtype: torch.dtype = _NUMBER
    """Data type."""
    of_step: bool = False
    """Whether it describes the step itself, and is zero at the start of an episode;
    otherwise it describes the resulting state."""

    @property
    def stays_in_worker(self) -> bool:
        """Whether it is read only inside the worker."""
        return not set(_PARENT) & set(self.read_by)

    def spec(
        self, num_envs: int, sizes: Mapping[str, int], device: torch.device
    ) -> TensorSpec:
        """Return the spec, ``[B, ...]``."""
        kind = Binary if self.dtype == torch.bool else Unbounded
        own = (sizes[n] if isinstance(n, str) else n for n in self.shape)
        shape = torch.Size((num_envs, *own))
        return kind(shape=shape, dtype=self.dtype, device=device)


def _event(
    name: str,
    size: int | str,
    content: str,
    *read_by: Reader,
    kind: torch.dtype = _FLAG,
) -> StateKey:
    """Return a row that describes a step (``of_step``)."""
    return StateKey(name, (size,), content, read_by, kind, of_step=True)


_WORKER: tuple[Reader, ...] = ("sensors", "observations")
_OBSERVED: tuple[Reader, ...] = ("observations",)
_PARENT: tuple[Reader, ...] = ("trainer", "evaluation")
STATE = (
    StateKey("base_pose", (7,), "position [m], quaternion (w, x, y, z)", _WORKER),
    StateKey("base_lin_vel_w", (3,), "velocity of the base's origin [m/s]", _OBSERVED),
    StateKey("base_ang_vel_b", (3,), "angular velocity [rad/s]", _OBSERVED),
    StateKey("joint_pos", ("J",), "joint positions [rad]", _WORKER),
    StateKey("joint_vel", ("J",), "joint velocities [rad/s]", _WORKER),
    StateKey(
        "object_pose", ("O", 7), "position [m], quaternion, in the world", _WORKER
    ),
    StateKey("object_lin_vel_w", ("O", 3), "velocity of the objects [m/s]", _OBSERVED),
    StateKey("object_active", ("O",), "whether the object is in play", _WORKER, _FLAG),
    _event("tactile", "L", "whether each link touched ball or floor", "sensors"),
    StateKey(
        "displacement_w", (2,), "displacement from the start [m], planar", _OBSERVED
    ),
    StateKey(
        "previous_action", ("J",), "action of the previous step (0 at first)", _OBSERVED
    ),
    _event("reward_terms", "R", "weighted terms, as TERMS", "trainer", kind=_NUMBER),
    _event("hit", 1, "a ball touched the robot", *_PARENT),
    _event("fallen", 1, "a link other than a foot touched the floor", *_PARENT),
    _event("diverged", 1, "the simulation failed", *_PARENT),
    _event("self_contact", 1, "the robot touched itself", "trainer"),
    _event("power", 1, "mechanical power of the joints [W]", kind=_NUMBER),
    _event("torque_saturation", 1, "share of joints at their limit", kind=_NUMBER),
    _event("object_hit", "O", "whether the object touched the robot"),
    _event("object_arrived", "O", "... or has passed, since it was thrown"),
    StateKey("balls_arrived", (2,), "first ball, later ones: arrived", ("evaluation",)),
    StateKey("balls_avoided", (2,), "... of which without touching", ("evaluation",)),
    StateKey("episode_step", (1,), "age in control steps", ("trainer",), _COUNT),
    StateKey("first_throw_step", (1,), "age at the first throw", _PARENT, _COUNT),
)
"""Every key, in the order of the output."""


def keys_read_by(*readers: Reader) -> list[str]:
    """Return the names of the keys that at least one of the readers reads."""
    return [key.name for key in STATE if set(readers) & set(key.read_by)]


def state_spec(
    keys: Sequence[StateKey],
    num_envs: int,
    sizes: Mapping[str, int],
    device: torch.device,
) -> Composite:
    """Return the spec of an output.

    Args:
        keys: Rows of the table.
        num_envs: Number of rows ``B``.
        sizes: Size for each letter in the shapes.
        device: Device of the output.
    """
    specs = {key.name: key.spec(num_envs, sizes, device) for key in keys}
    return Composite(specs, shape=torch.Size([num_envs]), device=device)


def state_table() -> str:
    """Return the table as reStructuredText."""
    rows = [("key", "shape", "content")]
    for key in STATE:
        shape = ", ".join(str(n) for n in ("B", *key.shape))
        rows.append((f"``{key.name}``", f"``[{shape}]``", key.content))
    width = [max(len(row[i]) for row in rows) for i in range(3)]
    rule = " ".join("=" * w for w in width)
    lines = [
        " ".join(x.ljust(w) for x, w in zip(row, width, strict=True)).rstrip()
        for row in rows
    ]
    return "\n".join([rule, lines[0], rule, *lines[1:], rule])
