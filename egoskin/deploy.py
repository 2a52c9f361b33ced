"""Run a policy on a robot: from joint states and raw distances to joint targets.

Needs only numpy, onnxruntime and this file of the package; see docs/deploy.md.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime


class Controller:
    """Runs an exported policy; call `step` once per control step.

    It stops, and stays stopped, when body state or distances are too old, state or
    action are not finite, or too many distances are missing (a missing one counts as no
    detection). `stopped` then holds the reason, and `step` returns the last target.
    `metadata` is the file's description of robot, skin and policy.

    Args:
        path: The exported policy.
        max_age: Stop when states or distances are older than this, or as far in the
            future [s].
        max_missing: Stop when more than this share of the distances is missing.
        margin: How far targets may lie outside the joint ranges, in units of torque
            limit / kp, the position error that commands full torque.
        max_change: Largest change of targets per control step, in the same unit.

    Raises:
        ValueError: If it is no exported policy, or newer than this file, or reads
            positions of balls, or if a limit is out of bounds.
        OSError: If it cannot be read.
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
        limits = {"max_age": max_age, "margin": margin, "max_change": max_change}
        for name, value in {**limits, "max_missing": max_missing}.items():
            most = 1 if name == "max_missing" else np.inf
            if not 0 <= value <= most:
                raise ValueError(f"{name} must be in [0, {most}], got {value}")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        content = Path(path).read_bytes()
        try:
            self._session = onnxruntime.InferenceSession(content, options)
        except Exception as error:  # onnxruntime's have no common base
            raise ValueError(f"{path} is not an ONNX file: {error}") from error
        text = self._session.get_modelmeta().custom_metadata_map.get("egoskin")
        if text is None:
            raise ValueError(f"{path} was not written by `egoskin export`")
        self.metadata: dict[str, Any] = json.loads(text)
        data, self._sensor = self.metadata, (sensor := self.metadata["sensor"])
        known = ("localization", "proximity", "closeness", "binary")
        if data["format"] != 1 or sensor["signal"] not in known:
            raise ValueError(f"{path} was written by a newer egoskin: update deploy.py")
        if "oracle" in sensor.values() or "localization" in sensor.values():
            raise ValueError(f"{path} reads positions of balls, which needs a tracker")
        self._default = np.array(data["default_joint_pos"])
        self._scale = np.array(data["action_scale"])
        self._range = np.repeat(np.array(data["range"], dtype=float), data["readings"])
        unit = np.array(data["torque_limit"]) / np.array(data["kp"])
        self._limits = np.double(data["joint_range"]) + margin * np.outer([-1, 1], unit)
        self._max_change = max_change * unit
        self._max_age, self._max_missing = max_age, max_missing
        self.reset()

    def reset(self) -> None:
        """Clear all state, including a stop; the next step begins an episode."""
        self.stopped: str | None = None
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
        """Return position targets of the joints [rad], ``[J]``, for the file's PD law.

        Args:
            base_quat: Unit quaternion of the base (w, x, y, z); any heading, ``[4]``.
            base_ang_vel_b: Angular velocity of the base in its frame [rad/s], ``[3]``.
            joint_pos: Joint positions in the file's order [rad], ``[J]``.
            joint_vel: Joint velocities [rad/s], ``[J]``.
            body_age: Age of these measurements [s].
            distance: Distances of the sensors [m], inf for no detection, NaN or
                negative if missing: ``[S]``, or ``[S, K]`` for grids; None for a blind
                policy.
            skin_age: Age of the distances [s].

        Raises:
            ValueError: If an input has the wrong shape.
        """
        joints = self._default.shape
        self._check_shape("base_quat", base_quat, (4,))
        self._check_shape("base_ang_vel_b", base_ang_vel_b, (3,))
        self._check_shape("joint_pos", joint_pos, joints)
        self._check_shape("joint_vel", joint_vel, joints)
        w, x, y, z = base_quat  # of the rotation R; gravity_b = R^T (0, 0, -1)
        gravity_b = -2 * np.array([x * z - w * y, y * z + w * x, 0.5 - x * x - y * y])
        deviation = np.asarray(joint_pos) - self._default
        blocks = [np.concatenate((base_ang_vel_b, deviation, joint_vel, gravity_b))]
        if not np.isfinite(blocks[0]).all():
            self.stop("the state of the body is not finite")
        if not abs(np.linalg.norm(base_quat) - 1) <= 0.01:
            self.stop("base_quat is not a unit quaternion")
        self._check_age("the state of the body is", body_age)
        if self.metadata["previous_action"]:
            blocks[0] = np.concatenate((blocks[0], self._action))
        if self._sensor["coverage"] != "none":
            blocks.append(self._signal(distance))
            self._check_age("the distances of the skin are", skin_age)
        # At the start, the joints stay where they are, within the limits.
        first = np.clip(self._default + np.nan_to_num(deviation), *self._limits)
        last = first if self._target is None else self._target
        self._target = last if self.stopped else self._next_target(blocks, last)
        return self._target.copy()

    def _check_age(self, what: str, age: float) -> None:
        """Stop if an input is too old, or if it comes from the future."""
        if not -self._max_age <= age <= self._max_age:
            self.stop(f"{what} {age:.3g} s old")

    def _check_shape(self, name: str, value: Any, *allowed: tuple[int, ...]) -> None:
        """Raise ValueError if an input of `step` has none of the allowed shapes."""
        if np.shape(value) not in allowed:
            texts = " or ".join(str(list(shape)) for shape in allowed)
            got = list(np.shape(value))
            raise ValueError(f"{name} must have the shape {texts}, got {got}")

    def _signal(self, distance: np.ndarray | None) -> np.ndarray:
        """Return the signal computed from distances."""
        found = np.asarray(np.nan * self._range if distance is None else distance)
        # Drivers report -1 for "no target".
        found = np.where(found < 0, np.nan, found)
        lost = np.isnan(found).mean()
        if self._sensor["reduce"] == "min" and found.ndim == 2:
            found = np.fmin.reduce(found, 1)
        readings = self.metadata["readings"]
        grid = [(len(readings), readings[0])] if len(set(readings)) == 1 else []
        self._check_shape("distance", found, self._range.shape, *grid)
        if lost > self._max_missing:
            self.stop(f"{lost:.0%} of the skin is missing")
        found = np.where(np.isnan(found), np.inf, found).reshape(len(self._range))
        limit = np.minimum(self._range, np.finfo(float).max)
        if self._sensor["signal"] == "binary":
            return (found <= limit) * 1.0
        # An infinite range has no scale: the signal of d is d / (d + 1 m).
        share = np.where(np.isinf(self._range), 1 - 1 / (1 + found), found / limit)
        share = np.clip(share, 0, 1)
        return 1 - share if self._sensor["signal"] == "closeness" else share

    def _next_target(self, blocks: list[np.ndarray], last: np.ndarray) -> np.ndarray:
        """Return the policy's target, within the limits."""
        # At the start of an episode, the history repeats the first observation.
        past = self._history or [blocks] * self.metadata["history"]
        self._history = [*past[1:], blocks]
        rows = [row for ages in zip(*self._history, strict=True) for row in ages]
        observation = np.concatenate(rows).astype(np.float32)[None]
        (output,) = self._session.run(["action"], {"observation": observation})
        self._action = np.asarray(output)[0].astype(float)
        if not np.isfinite(self._action).all():
            self.stop("the policy's action is not finite")
            return last
        # q* = q_default + scale x action
        target = np.clip(self._default + self._scale * self._action, *self._limits)
        return last + np.clip(target - last, -self._max_change, self._max_change)
