"""Ray sensors: grids of thin beams that measure the distance to their first hit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np
import pytorch_kinematics as pk
import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from egoskin.gradients import is_differentiated
from egoskin.robots.config import Primitive
from egoskin.rounding import matmul, matvec
from egoskin.sensors.geometry import (
    STATE_KEYS,
    ProximitySensor,
    Scene,
    View,
    checked,
)
from egoskin.sensors.kernels.binding import VECTOR
from egoskin.sensors.signals import Binary, Proximity
from egoskin.sensors.skin.coverage import Ray
from egoskin.sensors.skin.skin import Skin
from egoskin.shapes import Solid, first_hit
from egoskin.sparse import SparseRows

# Margin for rounding when pairs of sensor and object are culled [m].
_SLACK = 1e-4
# Readings processed at a time, so that temporaries stay in the cache.
_CHUNK = 2**17


class RaySensor(ProximitySensor):
    """Distance along each beam of each sensor to the closest active object in range.

    Reads ``base_pose [*B, 7]``, ``joint_pos [*B, J]``, ``object_pose [*B, O, 7]`` and
    ``object_active [*B, O]``. Writes ``distance [*B, S, K]`` [m] (with ``reduce``
    ``[*B, S]``), infinite where nothing is hit in range and NaN where the input is
    not finite, and ``object_detected [*B, O]``, whether any beam hits the object. A
    sensor inside an object reads 0 on every beam. Sensor poses are computed from the
    joint positions by forward kinematics.

    Only pairs of sensor and object for which the object's bounding sphere reaches into
    the field of view are computed (a few per cent); the result is the same.

    Finite readings above 0 are differentiable with respect to poses and joint
    positions, in reverse and forward mode (not under `torch.vmap`: use
    `torch.func.jacrev`). Of a sensor inside an object the derivative is 0.

    Args:
        skin: The sensors. A coverage or range set in the skin takes precedence; all
            sensors must have the same number of beams.
        chain: Kinematic chain of the robot, rooted at the base.
        objects: Shape of each of the ``O`` objects, or a single shape.
        max_range: A distance is detected if it is at most this [m]; may be infinite.
            None if the skin sets a range for every sensor.
        coverage: Coverage of sensors for which the skin sets none.
        reduce: "min" writes only the minimum over each sensor's beams.
        body: The robot's shapes, for occlusion, as in `FieldSensor`; empty: none.
        per_object: Write one distance per object, in a last dimension ``O``.
        compile: Use kernels if all objects are balls and there is no occlusion: in C++
            if it can be compiled, on CUDA in Warp if it is installed; only for float32
            without gradients. The results are the same.
        in_keys: Keys of the four inputs, in the order above.
        out_keys: Keys of the two outputs, in the order above.

    Raises:
        ValueError: If the range is not positive, the skin does not fit the chain,
            contains a sensor that is not a ray sensor or sensors with different numbers
            of beams, or another argument is of a wrong kind or number.
    """

    _beams: Tensor
    _beam_of: Tensor
    _depth: Tensor | None
    _pyramid: Tensor
    _reach: Tensor

    def __init__(
        self,
        skin: Skin,
        chain: pk.Chain,
        objects: Solid | Sequence[Solid],
        max_range: float | None = None,
        coverage: Ray | None = None,
        *,
        reduce: Literal["none", "min"] = "none",
        body: Sequence[Primitive] = (),
        per_object: bool = False,
        compile: bool = False,
        in_keys: Sequence[NestedKey] = STATE_KEYS,
        out_keys: Sequence[NestedKey] = ("distance", "object_detected"),
    ) -> None:
        if reduce not in ("none", "min"):
            raise ValueError(f"reduce must be 'none' or 'min', got {reduce!r}")
        skin, rays = checked(skin, coverage or Ray(), max_range, Ray)
        kinds = list(dict.fromkeys(rays))
        directions = [torch.from_numpy(kind.directions()) for kind in kinds]
        if len({d.shape for d in directions}) > 1:
            raise ValueError(
                "the sensors of one RaySensor must have the same number of beams; got "
                f"grids {', '.join(str(kind.grid) for kind in kinds)}"
            )
        self._num_beams = len(directions[0])
        self.reduce = reduce
        # [3, U, K] for U different coverages, and the index of each sensor's coverage.
        beams = torch.stack(directions).movedim(-1, 0)
        beam_of = torch.tensor([kinds.index(r) for r in rays])
        # Cosine and sine of the half angles along x and y of the pyramid around each
        # sensor's beams.
        slopes = (beams[:2].abs() / beams[2]).amax(-1)[:, beam_of]
        angles = slopes.atan()
        depth = torch.tensor([r.measure == "depth" for r in rays])
        super().__init__(
            skin,
            chain,
            objects,
            () if reduce == "min" else (self._num_beams,),
            body,
            per_object,
            in_keys,
            out_keys,
        )
        self.register_buffer("_beams", beams, persistent=False)
        self.register_buffer("_beam_of", beam_of, persistent=False)
        self.register_buffer("_depth", depth if depth.any() else None, persistent=False)
        pyramid = torch.stack((angles.cos(), angles.sin()))[..., None]
        self.register_buffer("_pyramid", pyramid, persistent=False)
        slant = torch.tensor([r.slant for r in rays], dtype=torch.float64)
        self.register_buffer("_reach", self._range * slant[:, None], persistent=False)
        # Temporaries should stay in the cache.
        self._chunk = max(1, _CHUNK // self._beams.shape[-1])
        if compile:
            bounds = [_SLACK + shape.bounding_radius for shape in self.objects]
            self._use_kernels(
                "ray",
                beams=self._num_beams,
                reduce=reduce == "min",
                bound=np.array(bounds),
                reach=self._reach.numpy(),
                pyramid=pyramid.permute(2, 0, 1, 3).numpy(),
                # Padded to whole vectors with copies of the last direction.
                directions=_padded(beams.transpose(0, 1).numpy()),
                grid=beam_of.numpy(),
                depth=depth.numpy() if depth.any() else None,
            )

    def margins(self, scene: Scene) -> tuple[Tensor, list[View]]:
        """Return the culling margin of each sensor and object, and the views.

        Returns:
            Margin [m] ``[O, B, S]``, 0 only where no beam can hit in range, and the
            `View` of each object.
        """
        views = self.views(scene)
        margins = [
            torch.where(on, self._margin(view, shape, scene.skin), 0.0).t().contiguous()
            for view, shape, on in zip(views, self.objects, scene.active, strict=True)
        ]
        return torch.stack(margins), views

    def _margin(self, view: View, shape: Solid, skin: dict[str, Tensor]) -> Tensor:
        """Margins of one object [m], ``[S, B]``."""
        away = view.centre[:, self._link] - skin["offset"]
        x, y, z = matvec(skin["axes"], away)
        # Outside the range, behind the sensor, or beyond a side of the pyramid:
        # R + r - |c|, r + z, r - (|x| cos h - z sin h).
        cos, sin = skin["pyramid"]
        far = (x * x + y * y + z * z).sqrt() - skin["reach"]
        beside = torch.maximum(
            x.abs() * cos[0] - z * sin[0], y.abs() * cos[1] - z * sin[1]
        )
        gap = torch.maximum(torch.maximum(far, beside), -z)
        return (shape.bounding_radius + _SLACK - gap).clamp(min=0.0)

    def read(
        self,
        scene: Scene,
        view: View,
        sensor: Tensor,
        row: Tensor,
        shape: Solid,
    ) -> tuple[Tensor, Tensor]:
        """Return the readings of one object for some pairs of sensor and row.

        Args:
            scene: The rows.
            view: The object in the link frames.
            sensor: Sensor of each pair, ``[n]``.
            row: Row of each pair, ``[n]``.
            shape: The object's shape.

        Returns:
            Readings [m], ``[n, K]`` or reduced ``[n]``, and the minimum of each pair,
            ``[n]``.
        """
        skin, link = scene.skin, self._link[sensor]
        axes, offset = skin["axes"][:, :, sensor, 0], skin["offset"][:, sensor, 0]
        away = view.centre[:, link, row] - offset
        beams = skin["beams"]
        if beams.shape[1] > 1:
            beams = beams[:, self._beam_of[sensor]]
        origin = [-c[:, None] for c in matvec(axes, away)]
        way = list(beams)
        if view.turn is not None:
            # Sensor to object: M R; the columns of R are the sensor's axes.
            turn = matmul(view.turn[:, :, link, row], axes.transpose(0, 1))[..., None]
            origin, way = matvec(turn, origin), matvec(turn, beams)
        distance = first_hit(*shape.ray_interval(*origin, *way))
        if self._occluder is not None:
            x, y, z = axes[..., None]
            way = x * beams[0] + y * beams[1] + z * beams[2]
            distance = self.hide(
                *(distance, scene, sensor, row, way, distance),
                target=away,
                radius=shape.bounding_radius,
            )
        if self._depth is not None:
            slanted = self._depth[sensor][:, None]
            distance = torch.where(slanted, distance * beams[2], distance)
        # Written so that NaN stays NaN.
        gone = distance > skin["range"][sensor]
        distance = torch.where(gone, torch.inf, distance)
        least = distance.amin(-1)
        return (least if self.reduce == "min" else distance), least

    def measure(self, scene: Scene, rows: Tensor, out: Tensor) -> Tensor:
        """Write the readings of some rows; return the minimum of each object."""
        least = scene.active.new_full(scene.active.shape, torch.inf, dtype=out.dtype)
        for i, row, place, reading, nearest in self._pairs(scene, rows):
            target = out[i] if self.per_object else out
            # view() and not reshape(): writes to a copy would be lost.
            flat = target.view(-1, *target.shape[2:])
            if i and not self.per_object:
                reading = torch.minimum(flat.index_select(0, place), reading)
            _put(flat, place, reading)
            least[i].scatter_reduce_(0, row, nearest, "amin")
        return least

    def _pairs(
        self, scene: Scene, rows: Tensor
    ) -> Iterator[tuple[int, Tensor, Tensor, Tensor, Tensor]]:
        """Yield object, rows, places, readings and their minima of all possible hits.

        Row indices are relative to the scene; a place is a sensor's index in ``[B S]``.
        """
        margins, views = self.margins(scene)
        for i, (view, shape) in enumerate(zip(views, self.objects, strict=True)):
            # Pairs with a margin that is not 0 may hit, including NaN.
            for part in _nonzero(margins[i]).split(self._chunk):
                row, sensor = part // self.num_sensors, part % self.num_sensors
                place = rows[row] * self.num_sensors + sensor
                yield i, row, place, *self.read(scene, view, sensor, row, shape)

    def hits(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return only the beams that hit: about a thousandth of the full grid.

        Args:
            inputs: Base pose, joint positions, object poses, active flags.

        Returns:
            Index in the flattened readings ``[B, S, K]`` of each beam that hits
            anything, ascending ``[n]`` int64, and its reading [m], ``[n]``.

        Raises:
            ValueError: If the sensor has ``reduce`` or ``per_object``, or an input is
                wrong (as in `compute`).
        """
        if self.reduce != "none" or self.per_object:
            raise ValueError("hits are of full grids: without reduce and per_object")
        self._check(inputs)
        if self._kernels is not None and self._kernels.can(*inputs[:3]):
            return self._kernels.hits(inputs)
        rows = self._rows_in_reach(*inputs)
        places, readings = [rows.new_empty(0)], [inputs[0].new_empty(0)]
        if not len(rows):
            return places[0], readings[0]
        scene = self.scene(*(x[rows] for x in inputs))
        for _, _, place, reading, _ in self._pairs(scene, rows):
            # NaN counts as a hit.
            hit = _nonzero(reading != torch.inf)
            beam = hit % self._num_beams
            places.append(place[hit // self._num_beams] * self._num_beams + beam)
            readings.append(reading.flatten()[hit])
        return _nearest(torch.cat(places), torch.cat(readings))


class SparseRays:
    """The signal of full ray grids as `egoskin.sparse.SparseRows`, ``[B, S K]``.

    Stores the values only of beams that hit something, equal to those of the
    transforms. For agents that learn from thousands of beams.

    Args:
        sensor: Sensors without ``reduce`` and without ``per_object``.
        reading: Transform from distance to signal, the same for every sensor.
    """

    def __init__(self, sensor: RaySensor, reading: Proximity | Binary) -> None:
        self._sensor, self._reading = sensor, reading
        self._default = float(reading.signal(torch.full((1, 1), torch.inf)))
        self.size = sensor.readings.numel()
        self.in_keys = [str(key) for key in sensor.in_keys]

    @torch.no_grad()
    def __call__(self, tensordict: TensorDictBase) -> SparseRows:
        """Return the signal of each row ``[B]``, on the device of the tensordict."""
        given = [tensordict[key] for key in self.in_keys]
        for part in (self._sensor, self._reading):
            part.to(given[0].device)
        place, distance = self._sensor.hits(*given)
        starts = torch.arange(len(given[0]) + 1, device=place.device) * self.size
        return SparseRows(
            offsets=torch.searchsorted(place, starts),
            column=place % self.size,
            value=self._reading.signal(distance[None])[0],
            size=self.size,
            default=self._default,
        )


def _nearest(place: Tensor, reading: Tensor) -> tuple[Tensor, Tensor]:
    """Return unique places, ascending, with their minimum readings; NaN stays NaN.

    Args:
        place: Places, ``[n]``.
        reading: Their readings [m], ``[n]``.
    """
    # Places are nearly sorted: a stable sort takes less time than unique().
    place, order = place.sort(stable=True)
    place, group = place.unique_consecutive(return_inverse=True)
    least = reading.new_full(place.shape, torch.inf)
    return place, least.scatter_reduce_(0, group, reading[order], "amin")


def _padded(directions: np.ndarray) -> np.ndarray:
    """Return ``[..., n]`` with n padded to a multiple of the kernels' vector size."""
    extra = -directions.shape[-1] % VECTOR
    return np.pad(directions, [(0, 0)] * (directions.ndim - 1) + [(0, extra)], "edge")


def _numpy_serves(x: Tensor) -> bool:
    """Whether NumPy may operate on a tensor's memory."""
    return x.is_cpu and not is_differentiated(x)


def _nonzero(x: Tensor) -> Tensor:
    """Return the indices of the entries that are not 0, ``[n]``."""
    if _numpy_serves(x):
        # PyTorch's nonzero takes several times as long.
        return torch.from_numpy(np.flatnonzero(x.numpy() != 0))
    return x.flatten().nonzero()[:, 0]


def _items(x: Tensor) -> np.ndarray:
    """Return a view of a tensor with each row as one item, ``[n]``."""
    array = x.numpy()
    return array.view(np.dtype((np.void, array[:1].nbytes))).reshape(-1)


def _put(grid: Tensor, rows: Tensor, values: Tensor) -> None:
    """Write some rows of a grid."""
    if _numpy_serves(grid) and _numpy_serves(values):
        # Rows are short. NumPy copies each as one item; PyTorch copies number by
        # number, which takes twice as long.
        _items(grid)[rows.numpy()] = _items(values.contiguous())
    else:
        grid[rows] = values
