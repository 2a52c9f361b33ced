"""A policy on a robot: from joint states and raw distances to joint targets.

Needs numpy and onnxruntime alone, and of this package this file alone. A `Controller`
runs a file that `egoskin export` wrote; docs/deploy.md has the loop around it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime


class Controller:
    """Runs an exported policy, one call of `step` for each control step.

    It stops, and stays stopped, when the body's state or the skin's distances are too
    old, when the state or the action is not finite, or when too many sensors are
    missing; one that is missing reads as one that finds nothing. Stopped, it gives the
    last target again, and `stopped` says why: what the motors do then (damp, say) is
    the driver's business.

    Args:
        path: The exported policy.
        max_age: Stop when states or distances are older than this [s].
        max_missing: Stop when more than this share of the distances is missing.
        margin: Targets may lie this far outside the joints' ranges, in units of torque
            limit / kp, the error that asks for the full torque. (A policy is trained to
            ask for torque so; targets within the ranges ask an ankle for little.)
        max_change: Targets move at most this far in a control step, in the same unit.

    Raises:
        ValueError: If the file is no exported policy, or reads what no skin tells.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        max_age: float = 0.1,
        max_missing: float = 0.1,
        margin: float = 1.0,
        max_change: float = 2.0,
    ) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # The network is small.
        self._session = onnxruntime.InferenceSession(str(path), options)
        text = self._session.get_modelmeta().custom_metadata_map.get("egoskin")
        if text is None:
            raise ValueError(f"{path} was not written by `egoskin export`")
        self.metadata: dict[str, Any] = json.loads(text)
        """All that the file says of the robot, the skin and the policy."""
        data, sensor = self.metadata, self.metadata["sensor"]
        self._coverage, self._signal = sensor["coverage"], sensor["signal"]
        if self._coverage == "oracle" or self._signal == "localization":
            raise ValueError(
                f"{path} reads where the ball is, for which a robot needs a tracker: "
                "deploy a policy of proximity, closeness or binary"
            )
        self._default, self._scale = map(np.array, (data[k] for k in _POSE))
        self._range = np.repeat(np.array(data["range"], float), data["readings"])
        self._names = {part["name"] for part in data["observation"]}
        unit = np.array(data["torque_limit"]) / np.array(data["kp"])
        low, high = np.array(data["joint_range"])
        self._low, self._high = low - margin * unit, high + margin * unit
        self._max_change = max_change * unit
        self._max_age, self._max_missing = max_age, max_missing
        self.reset()

    def reset(self) -> None:
        """Forget what was, a stop as well: the next step begins an episode."""
        self.stopped: str | None = None
        """Why it has stopped; None while it runs."""
        self._action = np.zeros(len(self._default))
        self._target: np.ndarray | None = None
        self._history: list[list[np.ndarray]] = []

    def stop(self, why: str) -> None:
        """Stop until the next reset."""
        self.stopped = self.stopped or why

    def step(
        self,
        *,
        base_quat: np.ndarray,
        base_ang_vel_b: np.ndarray,
        joint_pos: np.ndarray,
        joint_vel: np.ndarray,
        body_age: float,
        distance: np.ndarray | None = None,
        skin_age: float = 0.0,
    ) -> np.ndarray:
        """Return position targets of the joints [rad], ``[J]``, always within limits.

        They are for the PD law of the file's gains; joints are in the file's order.

        Args:
            base_quat: Orientation of the base in the world (w, x, y, z), ``[4]``; its
                heading does not matter.
            base_ang_vel_b: Angular velocity of the base in its frame [rad/s], ``[3]``.
            joint_pos: Joint positions [rad], ``[J]``.
            joint_vel: Joint velocities [rad/s], ``[J]``.
            body_age: How old these are [s].
            distance: What the sensors measure [m], infinite for nothing, NaN for a
                sensor that is missing: ``[S]``, or ``[S, K]`` for grids of beams. A
                blind policy needs none.
            skin_age: How old the distances are [s].
        """
        w, u = base_quat[0], np.asarray(base_quat[1:], float)
        # R^T (0, 0, -1) of a unit quaternion
        down = np.array([0.0, 0.0, -1.0])
        turn = 2 * np.cross(u, down)
        gravity_b = down - w * turn + np.cross(u, turn)
        deviation = joint_pos - self._default
        blocks = [np.concatenate((base_ang_vel_b, deviation, joint_vel, gravity_b))]
        if self._target is None:
            self._target = np.clip(np.nan_to_num(joint_pos), self._low, self._high)
        if not np.isfinite(blocks[0]).all():
            self.stop("the state of the body is not finite")
        if not body_age <= self._max_age:
            self.stop(f"the state of the body is {body_age:.3g} s old")
        if "previous_action" in self._names:
            blocks[0] = np.concatenate((blocks[0], self._action))
        if self._coverage != "none":
            blocks.append(self._read(distance, skin_age))
        if self.stopped is None:
            self._act(blocks)
        return self._target.copy()

    def _read(self, distance: np.ndarray | None, age: float) -> np.ndarray:
        """Return the signal of the distances, ``[n]``."""
        if distance is None or not age <= self._max_age:
            self.stop(f"the distances of the skin are {age:.3g} s old, or missing")
        distance = np.asarray(distance)
        return distance
