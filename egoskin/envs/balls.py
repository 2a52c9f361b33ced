"""Objects thrown at robots: when each is thrown, and whether it hits or is avoided.

Contract: a throw is a function of the draws of `Thrower` and of the robot's state at
release; contacts are those reported by the physics. All counts are per row.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from egoskin.envs.physics.contract import Physics, PhysicsState
from egoskin.envs.throws import Thrower
from egoskin.rounding import pad_rows
from egoskin.shapes import Shape

PASSED_DISTANCE = 1.0
"""A ball has passed once it flies away from the base and is farther than this [m]."""


class Balls:
    """The objects of every row: thrown in turn, in play until they land.

    Args:
        thrower: Draws the throws and aims them.
        objects: Shape of each of the ``O`` objects.
        num_envs: Number of rows ``B``.
        control_hz: Rate of the control steps [Hz].
        device: Device of all tensors.
    """

    def __init__(
        self,
        thrower: Thrower,
        objects: Sequence[Shape],
        num_envs: int,
        control_hz: float,
        device: torch.device,
    ) -> None:
        self.thrower = thrower
        self._hz, self._num_objects = control_hz, len(objects)
        heights = [shape.half_height for shape in objects]
        number = torch.float32
        self._half_height = torch.tensor(heights, dtype=number, device=device)
        zeros = torch.zeros(num_envs, dtype=torch.int64, device=device)
        flags = torch.zeros(num_envs, len(objects), dtype=torch.bool, device=device)
        self.state = {
            # Throws so far; episode steps at which the next and the first one are due.
            "throw": zeros,
            "next_throw_step": zeros.clone(),
            "first_throw_step": zeros.clone(),
            # For each object: whether it is in play, was thrown first, has arrived.
            "active": flags,
            "is_first": flags.clone(),
            "passed": flags.clone(),
            # First ball, later balls: arrived so far, and avoided (without contact).
            "arrived": torch.zeros(num_envs, 2, dtype=number, device=device),
            "avoided": torch.zeros(num_envs, 2, dtype=number, device=device),
        }
        """All counters and flags, ``[B, ...]`` each, for saving and restoring."""

    def start(self, rows: Tensor, seed: int, ids: Tensor, episode: Tensor) -> None:
        """Begin episodes with no object in play, and schedule the first throw.

        Args:
            rows: Rows whose episodes begin, ``[n]``.
            seed: Seed of the draws.
            ids: Global indices of these rows, padded (`pad_rows`).
            episode: Their episodes, padded.
        """
        for value in self.state.values():
            value[rows] = 0
        delay = self.thrower.first_delay(seed, ids, episode)[: len(rows)]
        steps = (delay * self._hz).round().long()
        for key in ("first_throw_step", "next_throw_step"):
            self.state[key][rows] = steps

    def due(self, step: Tensor) -> Tensor:
        """Return whether the next throw is due at an episode step, ``[B]`` bool."""
        return step >= self.state["next_throw_step"]

    def throw(
        self,
        physics: Physics,
        rows: Tensor,
        step: Tensor,
        seed: int,
        ids: Tensor,
        episode: Tensor,
    ) -> None:
        """Throw the next object of some rows at the robot in its current state.

        Args:
            physics: The simulations.
            rows: Rows to throw in, ``[n]``, at least one.
            step: Their episode steps, ``[n]``.
            seed: Seed of the draws.
            ids: Global indices of these rows, padded (`pad_rows`).
            episode: Their episodes, padded.
        """
        state, n, padded = self.state, len(rows), pad_rows(rows)
        throw, robot = state["throw"], physics.read(padded)
        draw = self.thrower.draw(seed, ids, episode, throw[padded])
        release = self.thrower.release(
            draw, robot.base_pose, robot.base_lin_vel_w, robot.joint_pos
        )
        ball = throw[rows] % self._num_objects
        physics.throw(rows, ball, release.position[:n], release.velocity[:n])
        state["active"][rows, ball] = True
        state["passed"][rows, ball] = False
        state["is_first"][rows, ball] = throw[rows] == 0
        wait = (draw.interval[:n] * self._hz).round().long()
        state["next_throw_step"][rows] = step + wait.clamp(min=1)
        throw[rows] += 1

    def count(self, now: PhysicsState, hit_by: Tensor, sound: Tensor) -> None:
        """Count the balls that arrived and were avoided; deactivate those that landed.

        A ball has arrived when it touches the robot or has passed it. It has passed
        when it lands, or flies away from the base and is farther than a metre.

        Args:
            now: State after the control step.
            hit_by: Which objects touched the robot, ``[B, O]`` bool.
            sound: Which rows have not diverged, ``[B, 1]`` bool.
        """
        state = self.state
        gap = now.object_pose[..., :2] - now.base_pose[:, None, :2]
        away = now.object_lin_vel_w[..., :2] - now.base_lin_vel_w[:, None, :2]
        far = gap.square().sum(-1) > PASSED_DISTANCE**2
        landed = now.object_pose[..., 2] <= self._half_height
        leaving = ((gap * away).sum(-1) > 0) & far
        fresh = state["active"] & ~state["passed"] & sound
        avoided = fresh & (landed | leaving) & ~hit_by
        arrived = avoided | (fresh & hit_by)
        first = state["is_first"]
        for name, which in (("arrived", arrived), ("avoided", avoided)):
            state[name][:, 0] += (which & first).sum(-1)
            state[name][:, 1] += (which & ~first).sum(-1)
        state["passed"] |= arrived
        state["active"] &= ~landed
