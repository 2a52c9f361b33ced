"""Where sensors and objects are relative to each other: what all coverages share.

Kernels work on a structure of arrays with the batch last (``[S, B]``), in the order of
the skin, and use only +, -, x, /, `sincos` and `exact_sqrt` (`egoskin.compilation`): a
row's result has the same bits whatever rows are computed with it, compiled or not.

Contract: a reading of infinity means that nothing is in range; NaN in the input gives
a reading of NaN, never one of nothing.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import pytorch_kinematics as pk
import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Binary as BinarySpec
from torchrl.data import Composite, TensorSpec, Unbounded

from egoskin.compilation import compiled
from egoskin.kinematics import LinkKinematics, quat_to_entries
from egoskin.robots import Primitive
from egoskin.sensors.coverage import Coverage
from egoskin.sensors.occlusion import Occluder
from egoskin.sensors.skin import Skin
from egoskin.shapes import Shape, Sphere
from egoskin.transform import RowTransform

# Margin for rounding where rows or pairs are left out [m].
_SLACK = 1e-3

STATE_KEYS = ("base_pose", "joint_pos", "object_pose", "object_active")
"""Keys that every proximity sensor reads by default."""


class Scene(NamedTuple):
    """What kernels compute from, the batch last and contiguous: vectors are loaded."""

    base: Tensor
    """Pose of the base in the world, ``[7, B]``."""
    objects: Tensor
    """Poses of the objects in the world, ``[O, 7, B]``; all NaN where any input is."""
    active: Tensor
    """Which objects are in play, ``[O, B]`` bool."""
    sin: Tensor
    """Sines of the joint positions that matter, ``[U, B]``."""
    cos: Tensor
    """Their cosines, ``[U, B]``."""
    joints: Tensor
    """These joint positions, ``[U, B]``."""
    links: tuple[Tensor, Tensor] | None
    """Rotations ``[3, 3, L, B]`` and positions [m] ``[3, L, B]`` of all links in the
    base frame; None for a robot that is transparent to its sensors."""
    skin: dict[str, Tensor]
    """Constants of the sensors in the dtype of the inputs: loops do not convert."""


class View(NamedTuple):
    """One object as the links see it."""

    centre: Tensor
    """Centre of the object in the link frames [m], ``[3, L, B]``."""
    turn: Tensor | None
    """Rotation from the link frames into the object's, ``[3, 3, L, B]``; None for a
    sphere, which has no orientation."""


def stack_frames(frames: list, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return link frames as tensors: rotation ``[3, 3, L, B]``, position ``[3, L, B]``.

    Args:
        frames: What `LinkKinematics.link_frames` returned.
        like: ``[..., B]``: tells batch, dtype and device, also where all frames are
            constants of the robot.
    """
    entries = [e for r, p in frames for e in (*r[0], *r[1], *r[2], *p)]
    batch = like.shape[-1:]
    full = [e if isinstance(e, Tensor) else like.new_full(batch, e) for e in entries]
    stacked = torch.stack(full).unflatten(0, (len(frames), 12)).transpose(0, 1)
    return stacked[:9].unflatten(0, (3, 3)), stacked[9:]


def product(a: Tensor, b: Tensor) -> Tensor:
    """Return the matrix product over the first two dimensions, ``[3, 3, *B]``.

    Written out: a library's product may round differently for another batch.

    Args:
        a: ``[3, 3, *B]``.
        b: ``[3, 3, *B]``, broadcastable.
    """
    return torch.stack(
        [
            torch.stack(
                [a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]
                 for j in range(3)]
            )
            for i in range(3)
        ]
    )  # fmt: skip


def _poison(base_pose: Tensor, joint_pos: Tensor, object_pose: Tensor) -> Tensor:
    """Return 0 or, for NaN in the row or in the object, NaN, ``[B, O]``: 0 NaN = NaN.

    It makes all readings of the object NaN, culled or not; no comparison discards it.
    """
    row = 0.0 * (joint_pos.sum(-1) + base_pose.sum(-1))
    return row[:, None] + 0.0 * object_pose.sum(-1)


def _matrix(quat: Tensor) -> Tensor:
    """Return rotation matrices ``[3, 3, B]`` of unit quaternions ``[4, B]``."""
    return torch.stack(quat_to_entries(quat.unbind(0))).unflatten(0, (3, 3))


class ProximitySensor(RowTransform):
    """What field and ray sensors share: keys, checks, the loop over objects.

    Args:
        skin: The sensors, filled; all of the coverage that the subclass computes.
        chain: Kinematic chain of the robot, rooted at the base.
        objects: Shape of each object, ``O`` of them.
        num_readings: Readings of each sensor: ``()`` or ``(K,)``.
        body: Shapes of the robot that hide what lies behind them; empty for a robot
            that is transparent to its sensors.
        per_object: Whether objects are told apart: readings have a last dimension
            ``O``, instead of those of the nearest object.
        compile: Whether the kernels are compiled.
        in_keys: Keys of base pose, joint positions, object poses, active flags.
        out_keys: Keys of readings and detections.

    Raises:
        ValueError: If the skin does not fit the chain, or there is no object.
    """

    _link: Tensor
    _offset: Tensor
    _axes: Tensor
    _range: Tensor

    def __init__(
        self,
        skin: Skin,
        chain: pk.Chain,
        objects: Sequence[Shape],
        num_readings: tuple[int, ...],
        body: Sequence[Primitive],
        per_object: bool,
        compile: bool,
        in_keys: Sequence[NestedKey],
        out_keys: Sequence[NestedKey],
    ) -> None:
        super().__init__(in_keys, out_keys)
        skin.check_links(chain.get_link_names())
        if not objects:
            raise ValueError("a proximity sensor needs at least one object to sense")
        self.num_sensors, self.objects = len(skin), tuple(objects)
        self.per_object, self._compile = per_object, compile
        self._prepare: Callable[..., Scene] = self.scene
        if compile:
            self._prepare = compiled(self.scene)
        self.readings = torch.Size((len(skin), *num_readings))
        links = list(dict.fromkeys(skin.links))
        self._num_links = len(links)
        links += dict.fromkeys(p.link for p in body if p.link not in links)
        self._occluder = Occluder(body, links) if body else None
        self._kinematics = LinkKinematics(chain, links)

        def constant(name: str, value: object, dtype: torch.dtype) -> None:
            self.register_buffer(name, torch.as_tensor(value, dtype=dtype))

        # Constants are float64; a scene has them in the dtype of its inputs.
        constant("_link", [links.index(name) for name in skin.links], torch.int64)
        constant("_offset", skin.position.T[:, :, None], torch.float64)
        # Columns of the sensor frames in the link frames, [3 (axis), 3, S, 1].
        constant("_axes", skin.rotation().transpose(2, 1, 0)[..., None], torch.float64)
        constant("_range", skin.range[:, None], torch.float64)
        # No object whose centre is farther from the base than this, plus its own
        # radius, is in range in any pose of the robot [m].
        reach = np.array(self._kinematics.reach())[self._link.numpy()]
        reach += np.linalg.norm(skin.position, axis=-1)
        self._farthest = float((reach + skin.reach()).max()) + _SLACK

    @property
    def num_joints(self) -> int:
        """Number of joint positions it reads, ``J``."""
        return self._kinematics.num_joints

    def scene(
        self, base_pose: Tensor, joint_pos: Tensor, object_pose: Tensor, active: Tensor
    ) -> Scene:
        """Return what the kernels compute from, given the four inputs.

        Compiled apart from them: otherwise their loops would load with strides, one
        number at a time.
        """
        poison = _poison(base_pose, joint_pos, object_pose)
        objects = (object_pose + poison[..., None]).permute(1, 2, 0).contiguous()
        base, on = base_pose.t().contiguous(), active.t().contiguous()
        trig = self._kinematics.trig(joint_pos)
        links = None
        if self._occluder is not None:
            links = stack_frames(self._kinematics.frames_from(*trig), base)
        skin = {
            name.removeprefix("_"): value.to(base_pose.dtype).contiguous()
            for name, value in self.named_buffers()
            if value.is_floating_point()
        }
        return Scene(base, objects, on, *trig, links, skin)

    def views(self, scene: Scene) -> list[View]:
        """Return each object as the links see it."""
        trig = scene.sin, scene.cos, scene.joints
        frames = self._kinematics.frames_from(*trig)[: self._num_links]
        base = _matrix(scene.base[3:])
        views = []
        for pose, shape in zip(scene.objects.unbind(0), self.objects, strict=True):
            # R^T d, written out: torch's cross product fuses sums, compiled code does
            # not.
            x, y, z = pose[:3] - scene.base[:3]
            centre = [
                base[0, i] * x + base[1, i] * y + base[2, i] * z for i in range(3)
            ]
            seen = []
            for rotation, position in frames:
                # q = R^T (c - p)
                x, y, z = (c - p for c, p in zip(centre, position, strict=True))
                columns = zip(*rotation, strict=True)
                seen.append([a * x + b * y + c * z for a, b, c in columns])
            turn = None
            if not isinstance(shape, Sphere):
                # Link to base to object: (R_base^T R_object)^T R_link.
                to_object = product(_matrix(pose[3:]).transpose(0, 1), base)
                links = stack_frames(frames, scene.base)[0]
                turn = product(to_object[:, :, None], links)
            # Stacked at once: in two steps compiled code copies them.
            along = [place for axis in zip(*seen, strict=True) for place in axis]
            views.append(View(torch.stack(along).unflatten(0, (3, -1)), turn))
        return views

    def frames_b(
        self, sin: Tensor, cos: Tensor, joints: Tensor
    ) -> tuple[list[Tensor], list[list[Tensor]]]:
        """Return the sensor frames in the base frame, entry by entry.

        Args:
            sin: Sines of the joint positions that matter, ``[U, B]``.
            cos: Their cosines, ``[U, B]``.
            joints: These joint positions, ``[U, B]``.

        Returns:
            Position [m], three of ``[S, B]``, and the rows of the rotation, 3 x 3 of
            ``[S, B]``; its columns are the axes of the sensor frames.
        """
        frames = self._kinematics.frames_from(sin, cos, joints)
        turn, origin = stack_frames(frames[: self._num_links], joints)
        offset = self._offset.to(turn.dtype)
        axes = self._axes.to(turn.dtype)
        position, rotation = [], []
        for row, along in zip(turn, origin, strict=True):
            x, y, z = row[:, self._link]
            # p + R o
            shift = x * offset[0] + y * offset[1] + z * offset[2]
            position.append(along[self._link] + shift)
            rotation.append([x * a[0] + y * a[1] + z * a[2] for a in axes])
        return position, rotation

    def poses_b(self, joint_pos: Tensor) -> tuple[Tensor, Tensor]:
        """Return the sensors' positions and rotations in the base frame.

        Args:
            joint_pos: Joint positions, ``[B, J]``.

        Returns:
            Position [m] ``[B, S, 3]`` and rotation ``[B, S, 3, 3]``, whose columns
            are the axes of the sensor frames.
        """
        position, rotation = self.frames_b(*self._kinematics.trig(joint_pos))
        rows = [torch.stack(row, -1).transpose(0, 1) for row in rotation]
        return torch.stack(position, -1).transpose(0, 1), torch.stack(rows, -2)

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
        """Return readings without those of paths that the robot's body blocks.

        Args:
            reading: Readings of some pairs of sensor and row [m], ``[n, K]``.
            scene: The rows.
            sensor: Sensor of each pair, ``[n]``.
            row: Row of each pair, ``[n]``.
            direction: Unit directions in the sensors' links, ``[3, n, K]``.
            length: Lengths of the paths [m], ``[n, K]``; infinite ones lead to nothing.
            target: Where the paths of each pair lead, as seen from the sensor, in its
                link [m], ``[3, n]``.
            radius: They end no farther from there than this [m].

        Returns:
            ``[n, K]``, infinite where blocked.
        """
        assert self._occluder is not None
        assert scene.links is not None
        link = self._link[sensor]
        turn, position = (x[..., link, row] for x in scene.links)
        offset = scene.skin["offset"][:, sensor, 0]

        def to_base(v: Tensor, of: Tensor | slice = slice(None)) -> list[Tensor]:
            return [r[0, of] * v[0] + r[1, of] * v[1] + r[2, of] * v[2] for r in turn]

        # p + R o
        x, y, z = offset
        origin = position + turn[:, 0] * x + turn[:, 1] * y + turn[:, 2] * z
        pair, path = (length < torch.inf).nonzero().unbind(1)
        hidden = torch.zeros_like(length, dtype=torch.bool)
        hidden[pair, path] = self._occluder.blocked(
            scene.links,
            row,
            origin,
            torch.stack(to_base(target)),
            radius,
            pair,
            to_base(direction[:, pair, path], pair),
            length[pair, path],
        )
        return torch.where(hidden, torch.inf, reading)

    @abstractmethod
    def measure(self, scene: Scene, rows: Tensor | None, out: Tensor) -> Tensor:
        """Write the readings of some rows, and return the least of each object.

        Args:
            scene: The rows, ``n`` of them.
            rows: Index of each of them, ``[n]``, all others being infinite already;
                None if they are all.
            out: Readings [m], ``[B, S, ...]`` or, told apart, ``[O, B, S, ...]``.

        Returns:
            Least reading of each object [m], ``[O, n]``, infinite if it is not active.
        """

    def compute(self, *inputs: Tensor, out: Tensor | None = None) -> tuple[Tensor, ...]:
        """Return (readings ``[B, S, ...]`` [m], detected ``[B, O]``).

        Args:
            inputs: Base pose, joint positions, object poses, active flags.
            out: Where to write the readings, contiguous; with ``per_object`` its
                first dimension is ``O``. A new tensor by default.

        Raises:
            ValueError: If the number of objects is not that of the sensor, a pose has
                not seven numbers, or the inputs are not of one floating type and bool.
        """
        self._check(inputs)
        batch, objects = inputs[3].shape
        if out is None:
            each = (objects,) if self.per_object else ()
            out = inputs[0].new_empty((*each, batch, *self.readings))
        if self._compile:
            # Compiled, all rows together cost less than to find those that matter.
            least = self.measure(self._prepare(*inputs), None, out)
            detected = least.t() != torch.inf
        else:
            rows = self._rows_in_reach(*inputs)
            out.fill_(torch.inf)
            detected = torch.zeros_like(inputs[3])
            if len(rows):
                scene = self._prepare(*(x[rows] for x in inputs))
                least = self.measure(scene, rows, out)
                # A reading of NaN may be anything: the object counts as seen.
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
                    "made with its batch_size?"
                )
        for key, tensor in zip(self.in_keys[2:], inputs[2:], strict=True):
            if tensor.shape[1] != len(self.objects):
                raise ValueError(
                    f"the sensor was made for {len(self.objects)} objects, {key!r} "
                    f"holds {tensor.shape[1]}"
                )
        types = [x.dtype for x in numbers]
        if len({*types}) > 1 or not types[0].is_floating_point:
            raise ValueError(
                f"{', '.join(map(repr, self.in_keys[:3]))} must be of one floating "
                f"type, got {', '.join(map(str, types))}"
            )
        if active.dtype != torch.bool:
            raise ValueError(f"{self.in_keys[3]!r} must be bool, got {active.dtype}")
        for i in (0, 2):
            if inputs[i].shape[-1] != 7:
                raise ValueError(
                    f"{self.in_keys[i]!r} must hold 7 numbers a pose (position, "
                    f"quaternion w x y z), got {inputs[i].shape[-1]}"
                )

    def _rows_in_reach(
        self,
        base_pose: Tensor,
        joint_pos: Tensor,
        object_pose: Tensor,
        active: Tensor,
    ) -> Tensor:
        """Rows with an active object that may be in range, or with NaN, ``[n]``."""
        bounds = [shape.bounding_radius for shape in self.objects]
        limit = self._farthest + object_pose.new_tensor(bounds)
        away = (object_pose[..., :3] - base_pose[:, None, :3]).square().sum(-1)
        away = away + _poison(base_pose, joint_pos, object_pose)
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
    skin: Skin, coverage: Coverage, max_range: float, kind: type[Coverage]
) -> tuple[Skin, list]:
    """Return the skin with nothing left open, and its coverages.

    Args:
        skin: The sensors.
        coverage: For sensors without one of their own.
        max_range: For sensors without a range of their own [m].
        kind: The coverage that all sensors must have.

    Raises:
        ValueError: If the range is not positive, or a sensor is of another kind.
    """
    if not max_range > 0:
        raise ValueError(f"max_range must be positive, got {max_range}")
    skin = skin.filled(coverage, max_range)
    for index, own in enumerate(skin.coverage):
        if not isinstance(own, kind):
            raise ValueError(
                f"sensor {index} is a {type(own).__name__}, not a {kind.__name__}; "
                "give this transform the others alone (Skin.select)"
            )
    return skin, list(skin.coverage)
