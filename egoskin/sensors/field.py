"""Field sensors: the distance to the closest point of an object."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import pytorch_kinematics as pk
import torch
from tensordict import NestedKey
from torch import Tensor

from egoskin.robots.config import Primitive
from egoskin.rounding import exact_sqrt, matvec
from egoskin.sensors.geometry import (
    STATE_KEYS,
    ProximitySensor,
    Scene,
    View,
    checked,
)
from egoskin.sensors.skin.coverage import Field
from egoskin.sensors.skin.skin import Skin
from egoskin.shapes import Solid, Sphere


class FieldSensor(ProximitySensor):
    """Distance from each sensor of a skin to the closest active object in range.

    Reads ``base_pose [*B, 7]``, ``joint_pos [*B, J]``, ``object_pose [*B, O, 7]`` and
    ``object_active [*B, O]``. Writes ``distance [*B, S]`` [m], infinite where nothing
    is in range and NaN where the input is not finite, and ``object_detected [*B, O]``,
    whether any sensor detects the object. A sensor inside an object reads 0. Sensor
    poses are computed from the joint positions by forward kinematics.

    A sensor with a half angle below 180 degrees sees an object if the object's
    closest point lies within that angle of the normal.

    Finite readings above 0 are differentiable with respect to poses and joint
    positions, in reverse and forward mode (not under `torch.vmap`: use
    `torch.func.jacrev`). Of a sensor inside an object the derivative is 0.

    Args:
        skin: The sensors. A coverage or range set in the skin takes precedence.
        chain: Kinematic chain of the robot, rooted at the base.
        objects: Shape of each of the ``O`` objects, or a single shape.
        max_range: A distance is detected if it is at most this [m]; may be infinite.
            None if the skin sets a range for every sensor.
        coverage: Coverage of sensors for which the skin sets none.
        body: The robot's shapes, for occlusion: an object is seen if the straight path
            to its closest point is free. A sensor inside a shape of its own link is
            taken to be on the surface above it; one inside a shape of another link sees
            nothing. Empty: no occlusion.
        per_object: Write one distance per object, ``distance [*B, S, O]``.
        compile: Use kernels if all objects are balls and there is no occlusion: in C++
            if it can be compiled, on CUDA in Warp if it is installed; only for float32
            without gradients. The results are the same.
        in_keys: Keys of the four inputs, in the order above.
        out_keys: Keys of the two outputs, in the order above.

    Raises:
        ValueError: If the range is not positive, the skin does not fit the chain or
            contains a sensor that is not a field sensor, or another argument is of a
            wrong kind or number.
    """

    _cos_half: Tensor | None

    def __init__(
        self,
        skin: Skin,
        chain: pk.Chain,
        objects: Solid | Sequence[Solid],
        max_range: float | None = None,
        coverage: Field | None = None,
        *,
        body: Sequence[Primitive] = (),
        per_object: bool = False,
        compile: bool = False,
        in_keys: Sequence[NestedKey] = STATE_KEYS,
        out_keys: Sequence[NestedKey] = ("distance", "object_detected"),
    ) -> None:
        skin, fields = checked(skin, coverage or Field(), max_range, Field)
        super().__init__(
            skin,
            chain,
            objects,
            (),
            body,
            per_object,
            in_keys,
            out_keys,
        )
        # None if every sensor sees in all directions.
        cos_half = None
        if any(f.half_angle_deg < 180 for f in fields):
            cosines = [
                # Rounding would hide an object straight behind a sensor of 180 degrees,
                # and straight beside one of 90 degrees, whose cosine would be 6e-17.
                {180: -math.inf, 90: 0.0}.get(
                    f.half_angle_deg, math.cos(math.radians(f.half_angle_deg))
                )
                for f in fields
            ]
            cos_half = torch.tensor(cosines, dtype=torch.float64)[:, None]
        self.register_buffer("_cos_half", cos_half, persistent=False)
        if compile:
            cone = None if cos_half is None else cos_half.numpy()
            self._use_kernels("field", cos_half=cone)

    def distances(self, scene: Scene) -> Tensor:
        """Return the readings of each object [m], ``[O, B, S]``."""
        readings = []
        for view, shape, on in zip(
            self.views(scene), self.objects, scene.active, strict=True
        ):
            distance = self._distance(view, shape, scene.skin)
            reading = torch.where(on, distance, torch.inf)
            if self._occluder is not None:
                reading = self._without_hidden(reading, view, shape, scene)
            readings.append(reading.t().contiguous())
        return torch.stack(readings)

    def _distance(self, view: View, shape: Solid, skin: dict[str, Tensor]) -> Tensor:
        """Readings of one object [m], ``[S, B]``."""
        # From each sensor to the object's centre, in the sensor's link.
        x, y, z = v = view.centre[:, self._link] - skin["offset"]
        if isinstance(shape, Sphere):
            # |c| - r: the object's frame differs by a translation only.
            to_centre = exact_sqrt(x * x + y * y + z * z)
            distance = (to_centre - shape.radius).clamp(min=0.0)
        else:
            distance = shape.signed_distance(*self._in_object(view, v)).clamp(min=0.0)
        if self._cos_half is not None:
            n = skin["axes"][2]
            way = self._to_closest(view, shape, v)
            along = n[0] * way[0] + n[1] * way[1] + n[2] * way[2]
            reach = exact_sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2])
            # cos(angle) < cos(half angle). An object that contains the sensor is always
            # in view.
            beside = (along < skin["cos_half"] * reach) & ~(distance <= 0)
            distance = torch.where(beside, torch.inf, distance)
        # Written so that NaN stays NaN.
        gone = distance > skin["range"]
        return torch.where(gone, torch.inf, distance)

    def _in_object(self, view: View, centre: Tensor) -> list[Tensor]:
        """Sensor positions in the object's frame [m], three of ``[S, B]``."""
        assert view.turn is not None
        return [-p for p in matvec(view.turn[:, :, self._link], centre)]

    def _to_closest(self, view: View, shape: Solid, centre: Tensor) -> Sequence[Tensor]:
        """Vector from each sensor to the object's closest point, in its link [m].

        For a sphere this is the vector to its centre: only the direction is correct.
        """
        if isinstance(shape, Sphere):
            return list(centre)
        p = self._in_object(view, centre)
        way = [a - b for a, b in zip(shape.closest_point(*p), p, strict=True)]
        assert view.turn is not None
        return matvec(view.turn[:, :, self._link].transpose(0, 1), way)

    def measure(self, scene: Scene, rows: Tensor, out: Tensor) -> Tensor:
        """Write the readings of some rows; return the minimum of each object."""
        readings = self.distances(scene)
        nearest = readings
        if not self.per_object:
            nearest = functools.reduce(torch.minimum, readings)
        out[..., rows, :] = nearest
        return readings.amin(-1)

    def _without_hidden(
        self, reading: Tensor, view: View, shape: Solid, scene: Scene
    ) -> Tensor:
        """Readings ``[S, B]``, infinite where the path to the object is blocked."""
        sensor, row = (reading < torch.inf).nonzero().unbind(1)
        if not len(row):
            return reading
        centre = view.centre[:, self._link] - scene.skin["offset"]
        way = self._to_closest(view, shape, centre)
        x, y, z = (w[sensor, row] for w in way)
        reach = exact_sqrt(x * x + y * y + z * z)
        way = torch.stack((x, y, z))
        direction = (way / reach.clamp(min=1e-9))[..., None]
        length = reach - shape.radius if isinstance(shape, Sphere) else reach
        found = reading[sensor, row][:, None]
        kept = self.hide(
            *(found, scene, sensor, row, direction, length[:, None]),
            target=way,
            radius=0.0,
        )
        return reading.index_put((sensor, row), kept[:, 0])
