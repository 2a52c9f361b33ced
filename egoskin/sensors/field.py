"""Field sensors: non-directional, the distance to the closest point of an object."""

from __future__ import annotations

from collections.abc import Sequence

import pytorch_kinematics as pk
import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Binary as BinarySpec
from torchrl.data import Composite, TensorSpec, Unbounded

from egoskin.kinematics import LinkKinematics, rotate_inverse
from egoskin.sensors.skin import Skin
from egoskin.shapes import Sphere
from egoskin.transform import RowTransform


def field_distance(points: Tensor, centres: Tensor, shape: Sphere) -> Tensor:
    """Return the distance from sensors to the closest point of an object.

    Args:
        points: Sensor positions [m], ``[3, S, B]``.
        centres: Centre of the object in the same frame [m], ``[3, B]``.
        shape: The object's shape.

    Returns:
        max(signed distance, 0) [m], ``[S, B]``: 0 for a sensor inside the object.
    """
    # The object's frame differs by a shift alone: a sphere needs no rotation.
    x, y, z = (p - c for p, c in zip(points, centres, strict=True))
    return shape.signed_distance(x, y, z).clamp_(min=0.0)


class FieldSensor(RowTransform):
    """Distance from each sensor of a skin to the closest active object in range.

    Reads ``base_pose [*B, 7]``, ``joint_pos [*B, J]``, ``object_pose [*B, O, 7]`` and
    ``object_active [*B, O]``. Writes ``distance [*B, S]`` [m], infinite where nothing
    is in range, and ``object_detected [*B, O]``, whether any sensor detects the
    object. The robot's own body is transparent. Distances are those of the state
    given: forward kinematics from the joint positions.

    Args:
        skin: The sensors.
        chain: Kinematic chain of the robot, rooted at the base.
        objects: Shape of each object, ``O`` of them.
        max_range: A distance is detected if it is at most this [m]; may be infinite.
        in_keys: Keys of the four inputs, in the order above.
        out_keys: Keys of the two outputs, in the order above.

    Raises:
        ValueError: If the range is not positive or the skin does not fit the chain.
    """

    _order: Tensor

    def __init__(
        self,
        skin: Skin,
        chain: pk.Chain,
        objects: Sequence[Sphere],
        max_range: float,
        in_keys: Sequence[NestedKey] = (
            "base_pose",
            "joint_pos",
            "object_pose",
            "object_active",
        ),
        out_keys: Sequence[NestedKey] = ("distance", "object_detected"),
    ) -> None:
        super().__init__(in_keys, out_keys)
        if not max_range > 0:
            raise ValueError(f"max_range must be positive, got {max_range}")
        skin.check_links(chain.get_link_names())
        self.max_range = float(max_range)
        self.num_sensors = len(skin)
        self.objects = tuple(objects)
        links = tuple(dict.fromkeys(skin.links))
        self._kinematics = LinkKinematics(chain, links)
        sensors = [
            [i for i, on in enumerate(skin.links) if on == link] for link in links
        ]
        self._offsets = [skin.position[group].tolist() for group in sensors]
        # Points come link by link; the signal is in the order of the skin.
        order = torch.tensor([i for group in sensors for i in group])
        self.register_buffer("_order", order.argsort())

    def points_b(self, joint_pos: Tensor) -> Tensor:
        """Return the sensors' positions in the base frame [m], ``[B, S, 3]``.

        Args:
            joint_pos: Joint positions [rad], ``[B, J]``.
        """
        points = self._kinematics.points_b(joint_pos, self._offsets)
        return points[:, self._order].permute(2, 1, 0)

    def compute(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return (distance ``[B, S]`` [m], detected ``[B, O]``)."""
        base_pose, joint_pos, object_pose, active = inputs
        if object_pose.shape[1] != len(self.objects):
            raise ValueError(
                f"the sensor was made for {len(self.objects)} objects, "
                f"{self.in_keys[2]!r} holds {object_pose.shape[1]}"
            )
        points = self._kinematics.points_b(joint_pos, self._offsets)
        nearest = torch.full_like(points[0], torch.inf)
        detected = []
        for i, shape in enumerate(self.objects):
            offset_w = object_pose[:, i, :3] - base_pose[:, :3]
            centres = rotate_inverse(base_pose[:, 3:], offset_w).t()
            distance = field_distance(points, centres, shape)
            seen = (distance <= self.max_range) & active[:, i]
            nearest = torch.where(seen, distance.minimum(nearest), nearest)
            detected.append(seen.any(0))
        return nearest[self._order].t().contiguous(), torch.stack(detected, -1)

    def out_specs(self, spec: Composite) -> Sequence[TensorSpec]:
        """Return the specs of distance and detection."""
        batch, objects = spec.shape, len(self.objects)
        return (
            Unbounded(
                shape=torch.Size((*batch, self.num_sensors)),
                dtype=spec[self.in_keys[1]].dtype,
            ),
            BinarySpec(shape=torch.Size((*batch, objects)), dtype=torch.bool),
        )
