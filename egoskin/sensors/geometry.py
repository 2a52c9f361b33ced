"""Relative geometry of sensors and objects, shared by all coverages.

Computations use a structure of arrays with the batch last (``[S, B]``), sensors in the
order of the skin, and only +, -, x, /, `sincos` and `exact_sqrt` (`egoskin.rounding`).
The result of a row is therefore bitwise the same whatever other rows are in the batch.
For balls without occlusion, float32 numbers are also the same in C++
(``egoskin/sensors/kernels/kernels.cpp``).

Contract: a reading of infinity means that nothing is in range; NaN in the input gives
a reading of NaN, never of infinity.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from copy import copy
from numbers import Real
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import pytorch_kinematics as pk
import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Binary as BinarySpec
from torchrl.data import Composite, TensorSpec, Unbounded

from egoskin.gradients import is_differentiated
from egoskin.robots.config import Primitive
from egoskin.robots.kinematics import LinkKinematics, quat_to_entries
from egoskin.rounding import matmul, matvec
from egoskin.sensors.kernels.binding import Kernels
from egoskin.sensors.occlusion import Occluder
from egoskin.sensors.skin.coverage import Coverage
from egoskin.sensors.skin.skin import Indices, Skin, indices
from egoskin.shapes import Solid, Sphere
from egoskin.transform import RowTransform

if TYPE_CHECKING:
    from typing_extensions import Self

# Margin for rounding when rows are culled [m].
_SLACK = 1e-3

STATE_KEYS = ("base_pose", "joint_pos", "object_pose", "object_active")
"""Keys that every proximity sensor reads by default."""


class Scene(NamedTuple):
    """Inputs of the computation, with the batch last."""

    base: Tensor
    """Pose of the base in the world, ``[7, B]``."""
    objects: Tensor
    """Poses of the objects in the world, ``[O, 7, B]``; all NaN where any input is."""
    active: Tensor
    """Which objects are active, ``[O, B]`` bool."""
    links: tuple[Tensor, Tensor]
    """Rotations ``[3, 3, L, B]`` and positions [m] ``[3, L, B]`` of the links in the
    base frame."""
    skin: dict[str, Tensor]
    """Constants of the sensors in the dtype of the inputs, converted only once."""


class View(NamedTuple):
    """Pose of one object relative to the links."""

    centre: Tensor
    """Centre of the object in the link frames [m], ``[3, L, B]``."""
    turn: Tensor | None
    """Rotation from the link frames into the object's, ``[3, 3, L, B]``; None for a
    sphere, which has no orientation."""


def _turned_back(rotation: Tensor, vector: Tensor) -> Tensor:
    """Return R^T v, ``[3, *B]``, for R ``[3, 3, *B]`` and v ``[3, *B]``."""
    x, y, z = vector
    return rotation[0] * x + rotation[1] * y + rotation[2] * z


def _writable(out: Tensor | None, shape: Sequence[int], like: Tensor) -> Tensor:
    """Return the given output tensor, or a new one.

    Raises:
        ValueError: If its shape, layout, dtype or device is wrong.
    """
    if out is None:
        return like.new_empty(shape)
    fits = out.shape == torch.Size(shape) and out.is_contiguous()
    if not fits or (out.dtype, out.device) != (like.dtype, like.device):
        raise ValueError(
            f"out must be {list(shape)}, contiguous, {like.dtype} on {like.device}; "
            f"got {list(out.shape)}, {out.dtype} on {out.device}"
        )
    return out


def _matrix(quat: Tensor) -> Tensor:
    """Return rotation matrices ``[3, 3, B]`` of quaternions ``[4, B]``."""
    return torch.stack(quat_to_entries(quat.unbind(0))).unflatten(0, (3, 3))


class ProximitySensor(RowTransform):
    """Base class of field and ray sensors: keys, checks, culling, forward kinematics.

    Args:
        skin: The sensors, resolved; all with the coverage that the subclass computes.
        chain: Kinematic chain of the robot, rooted at the base.
        objects: Shape of each of the ``O`` objects, or a single shape.
        num_readings: Shape of the readings of one sensor: ``()`` or ``(K,)``.
        body: Shapes of the robot that occlude objects; empty for no occlusion.
        per_object: Whether to write readings for each object, in a last dimension
            ``O``, instead of those of the nearest object.
        in_keys: Keys of base pose, joint positions, object poses, active flags.
        out_keys: Keys of readings and detections.

    Raises:
        ValueError: If the skin does not fit the chain, there is no object, an object is
            not a shape, or another argument is of a wrong kind or number.
    """

    _NUM_IN, _NUM_OUT = (4, 4), (2, 2)
    _link: Tensor
    _offset: Tensor
    _axes: Tensor
    _range: Tensor
    _farthest: Tensor

    def __init__(
        self,
        skin: Skin,
        chain: pk.Chain,
        objects: Solid | Sequence[Solid],
        num_readings: tuple[int, ...],
        body: Sequence[Primitive],
        per_object: bool,
        in_keys: Sequence[NestedKey],
        out_keys: Sequence[NestedKey],
    ) -> None:
        super().__init__(in_keys, out_keys)
        if not isinstance(chain, pk.Chain):
            raise ValueError(
                "chain must be a pytorch_kinematics.Chain (RobotConfig.chain), got "
                f"{type(chain).__name__}"
            )
        if not isinstance(body, Sequence) or not all(
            isinstance(part, Primitive) for part in body
        ):
            raise ValueError(
                "body must hold primitives (RobotConfig.primitives), got "
                f"{type(body).__name__}"
            )
        # The skin's robot may well have the link, if the chain is another robot's.
        skin.check_links(chain.get_link_names(), "the chain")
        self.num_sensors = len(skin)
        several = isinstance(objects, Iterable)
        self.objects = tuple(objects) if several else (objects,)
        if not self.objects:
            raise ValueError("a proximity sensor needs at least one object to sense")
        for shape in self.objects:
            # A class has the methods too.
            if isinstance(shape, type) or not isinstance(shape, Solid):
                raise ValueError(
                    "objects must be shapes (egoskin.shapes: Sphere, Box, ..), got "
                    f"{shape!r}"
                )
        self.per_object = per_object
        self.readings = torch.Size((len(skin), *num_readings))
        links = list(dict.fromkeys(skin.links))
        self._num_links = len(links)
        links += dict.fromkeys(p.link for p in body if p.link not in links)
        self._occluder = Occluder(body, links) if body else None
        self._kinematics = LinkKinematics(chain, links)
        self._joints = chain.get_joint_parameter_names()

        def constant(name: str, value: object, dtype: torch.dtype) -> None:
            # Copied, because `mask` changes the ranges of this sensor but not the skin.
            # A state dict must not carry the constants of one skin to another; of the
            # ranges, it carries which are masked.
            copied = torch.as_tensor(value, dtype=dtype).clone()
            self.register_buffer(name, copied, persistent=name == "_range")

        # Constants are float64; `scene` converts them to the dtype of its inputs.
        constant("_link", [links.index(name) for name in skin.links], torch.int64)
        constant("_offset", skin.position.T[:, :, None], torch.float64)
        # Axes of the sensor frames in the link frames, [3 (axis), 3, S, 1].
        constant("_axes", skin.rotation().transpose(2, 1, 0)[..., None], torch.float64)
        if self._occluder is not None:
            # Where the sensors' paths start for occlusion.
            start = self._occluder.outside(
                self._link, self._offset[..., 0], self._axes[2, ..., 0]
            )
            constant("_start", start[..., None], torch.float64)
        constant("_range", skin.range[:, None], torch.float64)
        self._skin_range = self._range.clone()
        # An object whose centre is farther from the base than this is out of range in
        # every pose of the robot [m], [O].
        reach = np.array(self._kinematics.reach())[self._link.numpy()]
        reach += np.linalg.norm(skin.position, axis=-1)
        farthest = float((reach + skin.reach()).max()) + _SLACK
        bounds = [farthest + shape.bounding_radius for shape in self.objects]
        constant("_farthest", bounds, torch.float64)
        self._kernels: Kernels | None = None

    def _use_kernels(self, kind: Literal["field", "ray"], **constants: Any) -> None:
        """Use kernels if all objects are balls and there is no occlusion.

        Args:
            kind: Coverage of the sensors.
            constants: Constants of the coverage for `Kernels`.
        """
        balls = [shape for shape in self.objects if isinstance(shape, Sphere)]
        if self._occluder is not None or len(balls) < len(self.objects):
            return
        own = {
            "sensors": self.num_sensors,
            "apart": self.per_object,
            "link": self._link.numpy(),
            "offset": self._offset[..., 0].t().numpy(),
            "axes": self._axes[..., 0].permute(2, 0, 1).numpy(),
            "range": self._range.numpy().copy(),
            "farthest": self._farthest.numpy(),
        }
        self._kernels = Kernels(kind, self._kinematics, balls, {**own, **constants})

    def mask(self, sensors: Indices) -> None:
        """Mask some sensors: they detect nothing. Replaces the previous mask.

        Args:
            sensors: Indices of the masked sensors, or ``[S]`` bool.

        Raises:
            ValueError: If there are flags, but not one for each sensor, or an index
                of no sensor.
        """
        sensors = indices(sensors, self.num_sensors)
        self._range.copy_(self._skin_range)
        # No distance is within a negative range.
        self._range[sensors] = -1.0
        self._tell_ranges()

    def _tell_ranges(self) -> None:
        """Give the ranges, with masks, to the kernels."""
        if self._kernels is not None:
            self._kernels.set_constants(range=self._range.cpu().numpy().copy())

    def clone(self) -> Self:
        """Return a copy for another environment, with a mask of its own."""
        new = super().clone()
        new._kernels = copy(self._kernels)
        return new

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        super()._load_from_state_dict(*args, **kwargs)
        # It may hold another mask; the ranges stay those of the skin.
        masked = self._range[:, 0] < 0
        self._range.copy_(self._skin_range)
        self._range[masked] = -1.0
        self._tell_ranges()

    @property
    def ranges(self) -> Tensor:
        """Range of each sensor [m], ``[S]`` float64; masks do not change it."""
        return self._skin_range[:, 0].clone()

    def scene(
        self, base_pose: Tensor, joint_pos: Tensor, object_pose: Tensor, active: Tensor
    ) -> Scene:
        """Return the scene of the four inputs."""
        if any(map(is_differentiated, (base_pose, joint_pos, object_pose))):
            # An object that is not active may have any pose, of zeros or NaN too, but
            # 0 times its derivatives must be 0: this one is far from all sensors.
            object_pose = torch.where(active[..., None], object_pose, 1e3)
        poison = self._poison(base_pose, joint_pos, object_pose)
        objects = (object_pose + poison[..., None]).permute(1, 2, 0).contiguous()
        skin = {
            name.removeprefix("_"): value.to(base_pose.dtype).contiguous()
            for name, value in self.named_buffers()
            if value.is_floating_point()
        }
        links = self._kinematics.link_frames(joint_pos)
        return Scene(
            base_pose.t().contiguous(), objects, active.t().contiguous(), links, skin
        )

    def views(self, scene: Scene) -> list[View]:
        """Return each object's pose relative to the links."""
        rotation, position = (x[..., : self._num_links, :] for x in scene.links)
        base = _matrix(scene.base[3:])
        views = []
        for pose, shape in zip(scene.objects.unbind(0), self.objects, strict=True):
            # R^T d, written out: torch's cross product uses fused operations.
            centre = _turned_back(base, pose[:3] - scene.base[:3])
            seen = _turned_back(rotation, centre[:, None] - position)
            turn = None
            if not isinstance(shape, Sphere):
                # Link to base to object: (R_base^T R_object)^T R_link.
                to_object = matmul(_matrix(pose[3:]).transpose(0, 1), base)
                turn = matmul(to_object[:, :, None], rotation)
            views.append(View(seen, turn))
        return views

    def poses_b(
        self, joint_pos: Tensor, out: tuple[Tensor, Tensor] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return the sensors' positions and rotations in the base frame.

        Args:
            joint_pos: Joint positions, ``[B, J]``.
            out: Contiguous tensors to write the result to. New ones by default.

        Returns:
            Position [m] ``[B, S, 3]`` and rotation ``[B, S, 3, 3]``, whose columns
            are the axes of the sensor frames.

        Raises:
            ValueError: If J is not the robot's number of joints, or ``out`` has a wrong
                shape, layout, dtype or device.
        """
        self._kinematics.check(joint_pos)
        shape = (len(joint_pos), self.num_sensors, 3)
        position, rotation = out or (None, None)
        position = _writable(position, shape, joint_pos)
        rotation = _writable(rotation, (*shape, 3), joint_pos)
        out = position, rotation
        kernels = self._kernels if joint_pos.is_cpu else None
        if kernels is not None and kernels.can(joint_pos, *out):
            kernels.poses(joint_pos, *out)
            return out
        rotation, position = self._kinematics.link_frames(joint_pos)
        offset = self._offset.to(joint_pos)
        # p + R o, and the axes rotated by R
        x, y, z = rotation[:, :, self._link].unbind(1)
        shift = x * offset[0] + y * offset[1] + z * offset[2]
        axes = [x * a[0] + y * a[1] + z * a[2] for a in self._axes.to(joint_pos)]
        out[0].copy_((position[:, self._link] + shift).permute(2, 1, 0))
        out[1].copy_(torch.stack(axes, 1).permute(3, 2, 0, 1))
        return out

    def hide(
        self,
        reading: Tensor,
        scene: Scene,
        sensor: Tensor,
        row: Tensor,
        direction: Tensor,
        length: Tensor,
        target: Tensor,
        radius: float,
    ) -> Tensor:
        """Return the readings, infinite where the robot's body blocks the path.

        Args:
            reading: Readings of some pairs of sensor and row [m], ``[n, K]``.
            scene: The rows.
            sensor: Sensor of each pair, ``[n]``.
            row: Row of each pair, ``[n]``.
            direction: Unit directions in the sensors' links, ``[3, n, K]``.
            length: Lengths of the paths [m], ``[n, K]``; infinite for no hit.
            target: Vector from each pair's sensor to the centre of the end points of
                its paths, in the sensor's link [m], ``[3, n]``.
            radius: Largest distance of an end point from that centre [m].

        Returns:
            ``[n, K]``, infinite where blocked.
        """
        assert self._occluder is not None
        link = self._link[sensor]
        turn, position = (x[..., link, row] for x in scene.links)
        # p + R o
        x, y, z = scene.skin["start"][:, sensor, 0]
        origin = position + turn[:, 0] * x + turn[:, 1] * y + turn[:, 2] * z
        pair, path = (length < torch.inf).nonzero().unbind(1)
        hidden = torch.zeros_like(length, dtype=torch.bool)
        hidden[pair, path] = self._occluder.blocked(
            scene.links,
            row,
            origin,
            torch.stack(matvec(turn, target)),
            radius,
            pair,
            matvec(turn[..., pair], direction[:, pair, path]),
            length[pair, path],
        )
        return torch.where(hidden, torch.inf, reading)

    @abstractmethod
    def measure(self, scene: Scene, rows: Tensor, out: Tensor) -> Tensor:
        """Write the readings of some rows; return the minimum of each object.

        The other entries of ``out`` are already infinite.

        Args:
            scene: The ``n`` rows.
            rows: Their indices in the batch, ``[n]``.
            out: Readings [m], ``[B, S, ...]``, or ``[O, B, S, ...]`` if per object.

        Returns:
            Minimum reading of each object [m], ``[O, n]``, infinite if not active.
        """

    def compute(self, *inputs: Tensor, out: Tensor | None = None) -> tuple[Tensor, ...]:
        """Return (readings ``[B, S, ...]`` [m], detected ``[B, O]``).

        Args:
            inputs: Base pose, joint positions, object poses, active flags.
            out: Contiguous tensor to write the readings to; with ``per_object`` its
                first dimension is ``O``. A new tensor by default.

        Raises:
            ValueError: If the number of objects or of joint positions is wrong, a pose
                does not have seven numbers, the inputs are not all float32 or all
                float64 (active flags: bool), or ``out`` has a wrong shape, layout,
                dtype or device.
        """
        self._check(inputs)
        batch, objects = inputs[3].shape
        each = (objects,) if self.per_object else ()
        out = _writable(out, (*each, batch, *self.readings), inputs[0])
        detected = torch.zeros(inputs[3].shape, dtype=torch.bool, device=out.device)
        if self._kernels is not None and self._kernels.can(*inputs[:3]):
            self._kernels.measure(inputs, out, detected)
        else:
            rows = self._rows_in_reach(*inputs)
            out.fill_(torch.inf)
            if len(rows):
                scene = self.scene(*(x[rows] for x in inputs))
                least = self.measure(scene, rows, out)
                # NaN could be any distance: the object counts as detected.
                detected[rows] = least.t() != torch.inf
        return (out.movedim(0, -1) if self.per_object else out), detected

    def _check(self, inputs: Sequence[Tensor]) -> None:
        """Raise ValueError for inputs of a wrong shape or type."""
        *numbers, active = inputs
        shapes = ("7",), ("J",), ("O", "7"), ("O",)
        for key, tensor, shape in zip(self.in_keys, inputs, shapes, strict=True):
            if tensor.ndim != 1 + len(shape):
                raise ValueError(
                    f"{key!r} must be [*B, {', '.join(shape)}], got "
                    f"{list(tensor.shape[1:])} after the batch: was the tensordict "
                    "made with its batch_size? (Batch dimensions of nested "
                    "tensordicts are not supported.)"
                )
            if len(tensor) != len(active):
                raise ValueError(
                    f"{key!r} has {len(tensor)} rows, but {self.in_keys[3]!r} has "
                    f"{len(active)}"
                )
        for key, tensor in zip(self.in_keys[2:], inputs[2:], strict=True):
            if tensor.shape[1] != len(self.objects):
                raise ValueError(
                    f"the sensor was made for {len(self.objects)} objects, but "
                    f"{key!r} holds {tensor.shape[1]}"
                )
        types = [x.dtype for x in numbers]
        if len({*types}) > 1 or types[0] not in (torch.float32, torch.float64):
            raise ValueError(
                f"{', '.join(map(repr, self.in_keys[:3]))} must all be float32 or all "
                f"float64, got {', '.join(map(str, types))}"
            )
        if active.dtype != torch.bool:
            raise ValueError(f"{self.in_keys[3]!r} must be bool, got {active.dtype}")
        for i in (0, 2):
            if inputs[i].shape[-1] != 7:
                raise ValueError(
                    f"{self.in_keys[i]!r} must hold 7 numbers per pose (position, "
                    f"quaternion w x y z), got {inputs[i].shape[-1]}"
                )
        if inputs[1].shape[-1] != len(self._joints):
            raise ValueError(
                f"{self.in_keys[1]!r} must hold {len(self._joints)} numbers "
                f"({', '.join(self._joints)}), got {inputs[1].shape[-1]}"
            )

    def _poison(
        self, base_pose: Tensor, joint_pos: Tensor, object_pose: Tensor
    ) -> Tensor:
        """Return NaN where a row's or object's input is invalid, else 0, ``[B, O]``.

        Invalid are numbers that are not finite (0 NaN = NaN) and zero quaternions
        (0 / 0 = NaN), except those of spheres. The NaN makes all readings of the object
        NaN, culled or not.
        """
        row = 0.0 * (joint_pos.sum(-1) + base_pose.sum(-1))
        row = row + 0.0 / base_pose[:, 3:].square().sum(-1)
        own = 0.0 * object_pose.sum(-1)
        sphere = [isinstance(shape, Sphere) for shape in self.objects]
        if not all(sphere):
            length = object_pose[..., 3:].square().sum(-1)
            length = length.masked_fill(torch.tensor(sphere).to(length.device), 1.0)
            own = own + 0.0 / length
        return row[:, None] + own

    def _rows_in_reach(
        self,
        base_pose: Tensor,
        joint_pos: Tensor,
        object_pose: Tensor,
        active: Tensor,
    ) -> Tensor:
        """Rows with an active object that may be in range or is NaN, ``[n]``."""
        limit = self._farthest.to(object_pose.dtype)
        away = (object_pose[..., :3] - base_pose[:, None, :3]).square().sum(-1)
        away = away + self._poison(base_pose, joint_pos, object_pose)
        return (~(away > limit * limit) & active).any(1).nonzero()[:, 0]

    def out_specs(self, spec: Composite) -> Sequence[TensorSpec]:
        """Return the specs of readings and detections."""
        batch, objects = spec.shape, len(self.objects)
        each = (objects,) if self.per_object else ()
        return (
            Unbounded(
                shape=torch.Size((*batch, *self.readings, *each)),
                dtype=spec[self.in_keys[1]].dtype,
            ),
            BinarySpec(shape=torch.Size((*batch, objects)), dtype=torch.bool),
        )


def checked(
    skin: Skin, coverage: Coverage, max_range: float | None, kind: type[Coverage]
) -> tuple[Skin, list]:
    """Return the resolved skin and its coverages.

    Args:
        skin: The sensors.
        coverage: Coverage of sensors for which the skin sets none.
        max_range: Range of sensors for which the skin sets none [m]; None if it sets
            all.
        kind: Required kind of coverage.

    Raises:
        ValueError: If the skin is not a `Skin`, the range is not a positive number, a
            sensor has no range, or its coverage is of another kind.
    """
    if not isinstance(skin, Skin):
        raise ValueError(
            f"skin must be a Skin (Skin.load for a file), got {type(skin).__name__}"
        )
    if max_range is not None and not isinstance(max_range, Real):
        raise ValueError(
            f"max_range must be one number, got {max_range!r}; a range for each sensor "
            "belongs in Skin.range"
        )
    if max_range is not None and not max_range > 0:
        raise ValueError(f"max_range must be positive, got {max_range}")
    if not skin.is_resolved:
        skin = skin.resolved(coverage, np.nan if max_range is None else max_range)
    if np.isnan(skin.range).any():
        index = int(np.isnan(skin.range).argmax())
        raise ValueError(f"sensor {index} has no range: give max_range")
    for index, own in enumerate(skin.coverage):
        if not isinstance(own, kind):
            raise ValueError(
                f"sensor {index} is a {type(own).__name__}, not a {kind.__name__}; "
                "pass only sensors of that kind (Skin.select), or let SensorPipeline "
                "make one transform for each kind"
            )
    return skin, list(skin.coverage)
