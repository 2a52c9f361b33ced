"""Imperfect sensors: the transform from true distances to sensor readings.

Imperfections (`egoskin.sensors.imperfections.models`) are frozen dataclasses that hold
their own parameters; `Corruption` applies a sequence of them to every reading of a
skin. Distances are in metres; infinite means that nothing is in range, and NaN marks an
invalid input and stays NaN.

Every random number is a function of (seed, global row, episode, step, model, reading):
results depend neither on the number of workers nor on which rows reset together.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from egoskin.bounds import BoundsError, check_bounds
from egoskin.rng import Stream, halfwords, random_words, stream_key
from egoskin.sensors.skin.skin import Indices, indices
from egoskin.transform import StatefulTransform, key_list

State = dict[str, Tensor]
"""State of a model between steps: tensors ``[B, ...]`` by name."""

# Fourth word of the generator's counter: 24 bits of block, 2 of purpose, 6 of model.
_PURPOSE_BIT, _MODEL_BIT = 24, 26
_MAX_MODELS = 1 << (32 - _MODEL_BIT)


@dataclass(frozen=True, kw_only=True)
class Moment:
    """Time of a batch of readings and their rows, for random draws."""

    seed: int
    """Seed of all draws."""
    dt: float
    """Duration of a control step [s]."""
    row: Tensor
    """Global row indices, ``[B]`` int64."""
    episode: Tensor
    """Episode of each row, ``[B]`` int64."""
    step: Tensor
    """Control steps since the start of the episode, ``[B]`` int64."""
    speed: Tensor
    """Speed of the fastest joint [rad/s], ``[B]``; 0 if no model depends on it."""
    redraw_traits: bool
    """Whether sensor properties are redrawn for each row and episode."""
    model: int = 0
    """Index of the model in the sequence; models draw independent numbers."""

    def words(self, row: Tensor, block: Tensor, purpose: int = 0) -> Tensor:
        """Return four random words for each of some rows at this step.

        Args:
            row: Rows of this batch, ``[n]`` int64.
            block: Index of the words within the row, ``[n]`` int64 in [0, 2**24).
            purpose: Number that separates different draws of a model, in [0, 4).

        Returns:
            Words in [0, 2**32), ``[4, n]`` int64.
        """
        return random_words(
            self.seed,
            Stream.SENSOR,
            self.row[row],
            self.episode[row],
            self.step[row],
            block + (purpose << _PURPOSE_BIT) + (self.model << _MODEL_BIT),
        )

    @cached_property
    def of_traits(self) -> Moment:
        """The moment for draws of constant sensor properties (traits)."""
        # Step -1 exists in no episode: traits are independent of all steps' draws.
        fixed = replace(self, step=torch.full_like(self.step, -1))
        if self.redraw_traits:
            return fixed
        zero = torch.zeros_like(self.row)
        return replace(fixed, row=zero, episode=zero)


class Places:
    """Places (indices) in readings ``[B, S, K]``, and the random numbers drawn there.

    Args:
        row: Rows of this batch, ``[n]`` int64, ascending.
        place: Places in the flat ``[S, K]`` of the row, ``[n]`` int64, ascending
            within a row.
        beams: Number of beams per sensor ``K``.
    """

    def __init__(self, row: Tensor, place: Tensor, beams: int) -> None:
        self.row, self.place = row, place
        self._beams = beams

    @cached_property
    def sensor(self) -> Tensor:
        """The sensor of each place, ``[n]`` int64."""
        if self._beams == 1:
            return self.place
        return self.place.div(self._beams, rounding_mode="floor")

    def index(self, shape: torch.Size) -> Tensor:
        """Return the places in the flat tensor of shape (B, S, K), ``[n]`` int64."""
        return self.row * shape[1:].numel() + self.place

    def draw(self, moment: Moment, purpose: int = 0) -> Tensor:
        """Return a random number for each place at this step.

        Args:
            moment: The moment of the readings.
            purpose: Number that separates different draws of a model, in [0, 4).

        Returns:
            Numbers in [0, 2**16), ``[n]`` int64.
        """
        return _numbers(self._readings, moment, purpose)

    def draw_trait(self, moment: Moment, purpose: int = 0) -> Tensor:
        """Return a random number for the sensor of each place, constant over time.

        Args:
            moment: The moment of the readings.
            purpose: Number that separates different draws of a model, in [0, 4).

        Returns:
            Numbers in [0, 2**16), ``[n]`` int64.
        """
        calls = self._readings if self._beams == 1 else _calls(self.row, self.sensor)
        return _numbers(calls, moment.of_traits, purpose)

    def draw_common(self, moment: Moment) -> Tensor:
        """Return a random number for each place at this step, shared within each row.

        Args:
            moment: The moment of the readings.

        Returns:
            Numbers in [0, 2**16), ``[n]`` int64.
        """
        return _numbers(_calls(self.row, torch.zeros_like(self.row)), moment, 0)

    @cached_property
    def _readings(self) -> tuple[Tensor, ...]:
        return _calls(self.row, self.place)


def _calls(row: Tensor, place: Tensor) -> tuple[Tensor, ...]:
    """Return the generator calls needed for some places.

    One call gives eight numbers, for eight adjacent places, and is made only if one of
    them is needed: most readings are infinite and need none.

    Args:
        row: Rows, ``[n]`` int64, ascending.
        place: Places in the row, ``[n]`` int64, ascending within a row.

    Returns:
        Row and block of each call ``[c]``; index of each place's number among the
        numbers of all calls ``[n]``.
    """
    key = (row << _PURPOSE_BIT) + (place >> 3)
    calls, inverse = torch.unique_consecutive(key, return_inverse=True)
    row, block = calls >> _PURPOSE_BIT, calls & ((1 << _PURPOSE_BIT) - 1)
    return row, block, (inverse << 3) + (place & 7)


def _numbers(calls: tuple[Tensor, ...], moment: Moment, purpose: int) -> Tensor:
    """Return the 16-bit numbers of the places of the calls, ``[n]``."""
    row, block, number = calls
    return halfwords(moment.words(row, block, purpose)).take(number)


class Model:
    """One imperfection of a sensor: a frozen dataclass of its parameters."""

    per_speed: float = 0.0
    """Dependence on the speed of the fastest joint [s/rad], if the model has one."""

    def __post_init__(self) -> None:
        """Raise ValueError for a parameter out of its bounds (`egoskin.bounds`)."""
        try:
            check_bounds(self)
        except BoundsError as error:
            raise ValueError(f"{type(self).__name__}.{error}") from error


class PointModel(Model, ABC):
    """A stateless model that changes finite readings independently of each other."""

    @abstractmethod
    def change(self, distance: Tensor, places: Places, moment: Moment) -> Tensor:
        """Return the changed distances [m], infinite for no detection, ``[n]``.

        Args:
            distance: Finite readings [m], ``[n]``.
            places: Their places among all readings.
            moment: The moment of the readings.
        """


class FrameModel(Model, ABC):
    """A model of all readings of a step together, which may have a state."""

    def start(self, reading: Tensor, moment: Moment) -> State:
        """Return the state before the first reading of an episode.

        Args:
            reading: First input of this model [m], ``[B, S, K]``.
            moment: The moment of the reading.
        """
        return {}

    @abstractmethod
    def apply(
        self, reading: Tensor, state: State, moment: Moment
    ) -> tuple[Tensor, State]:
        """Return the changed readings and the new state.

        Args:
            reading: Distances [m], ``[B, S, K]``; must not be modified.
            state: State after the previous reading; must not be modified.
            moment: The moment of the readings.
        """


def find(reading: Tensor) -> tuple[Tensor, Places]:
    """Return the finite readings of ``[B, S, K]``, and their places."""
    # One comparison excludes infinity and NaN.
    row, place = (reading.flatten(1) < torch.inf).nonzero(as_tuple=True)
    places = Places(row, place, reading.shape[2])
    return reading.take(places.index(reading.shape)), places


def put(reading: Tensor, places: Places, distance: Tensor) -> Tensor:
    """Return a copy of readings ``[B, S, K]`` with some places changed."""
    index = places.index(reading.shape)
    return reading.flatten().index_copy(0, index, distance).reshape(reading.shape)


class _Found:
    """The finite readings, while consecutive point models change them."""

    def __init__(self, reading: Tensor) -> None:
        self._reading = reading
        self._distance, self._places = find(reading)
        self._hidden = torch.zeros_like(self._distance, dtype=torch.bool)

    def change(self, model: PointModel, moment: Moment) -> None:
        """Apply one more model."""
        changed = model.change(self._distance, self._places, moment)
        # Later models get only finite distances; a lost detection stays lost.
        gone = changed == torch.inf
        self._hidden |= gone
        self._distance = torch.where(gone, self._distance, changed)

    def readings(self) -> Tensor:
        """Return all readings, including the changed ones, ``[B, S, K]``."""
        distance = self._distance.masked_fill(self._hidden, torch.inf)
        return put(self._reading, self._places, distance)


def corrupt(
    models: Sequence[Model],
    distance: Tensor,
    states: Sequence[State] | None,
    moment: Moment,
) -> tuple[Tensor, list[State]]:
    """Apply a sequence of models to distances; return readings and new states.

    Args:
        models: The models, in the order in which they apply.
        distance: True distances [m], ``[B, S, K]``; infinite where nothing is in
            range, NaN where the input was invalid.
        states: The state of each model; None starts an episode.
        moment: The moment of the reading.

    Returns:
        Readings [m], not negative, ``[B, S, K]``; and one state for each model.
    """
    reading, after = distance, []
    # Computed once for consecutive point models.
    found: _Found | None = None
    for i, model in enumerate(models):
        now, state = replace(moment, model=i), {}
        if isinstance(model, PointModel):
            found = found or _Found(reading)
            found.change(model, now)
        elif isinstance(model, FrameModel):
            if found is not None:
                reading, found = found.readings(), None
            state = model.start(reading, now) if states is None else states[i]
            reading, state = model.apply(reading, state, now)
        after.append(state)
    if found is not None:
        reading = found.readings()
    return reading.clamp(min=0.0), after


class Corruption(StatefulTransform):
    """Readings of imperfect sensors, from true distances.

    Reads ``distance [*B, S]`` or ``[*B, S, K]`` [m] (infinite: nothing in range; NaN
    stays NaN) and, if a model depends on the speed of the joints, ``joint_vel
    [*B, J]`` [rad/s]. Writes ``reading``, of the same shape and never negative;
    ``reading_clock [*B, 2]``, episode and step of each row; and ``reading_i_...``, the
    state of the i-th model. Signals read ``distance`` unless told otherwise: give them
    ``in_keys=["reading"]``, or they stay perfect.

    Rows are numbered from ``row_offset``: with the right offset for each worker,
    results do not depend on the number of workers. The episodes of a row are numbered
    from 0, across resets. Two of these transforms in one environment need two seeds.
    The environment's ``set_seed`` does not reach transforms: see `restart`.

    Args:
        models: Imperfections, in the order in which they apply.
        dt: Duration of a control step [s].
        seed: Seed of all draws, in [0, 2**32), or the result of
            `egoskin.rng.held_out`.
        row_offset: Global index of the first row.
        redraw_traits: Whether sensor properties (offsets, gains, phases, dead sensors)
            are redrawn for each row and episode, to train for any robot. If False, all
            rows and episodes have the same, which depend on the seed only.
        in_keys: Keys of the distance and, if needed, of the joint velocities.
        out_keys: Key of the reading; the other keys are derived from it.

    Raises:
        ValueError: If the control step is not positive, the seed is invalid, a model is
            neither a `PointModel` nor a `FrameModel`, there are too many models or the
            number of keys is wrong.
    """

    def __init__(
        self,
        models: Sequence[Model],
        *,
        dt: float,
        seed: int,
        row_offset: int = 0,
        redraw_traits: bool = True,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] = ("reading",),
    ) -> None:
        if not dt > 0:
            raise ValueError(f"dt must be positive, got {dt}")
        stream_key(seed, Stream.SENSOR)
        if not isinstance(models, Sequence) or not all(
            isinstance(model, PointModel | FrameModel) for model in models
        ):
            raise ValueError(
                "models must be a list of PointModel or FrameModel instances, got "
                f"{models!r}"
            )
        if len(models) > _MAX_MODELS:
            raise ValueError(f"at most {_MAX_MODELS} models, got {len(models)}")
        needed = ["distance"]
        if any(model.per_speed > 0 for model in models):
            needed.append("joint_vel")
        in_keys = key_list("in_keys", needed if in_keys is None else in_keys)
        if len(in_keys) != len(needed):
            raise ValueError(f"in_keys must name {', '.join(needed)}, got {in_keys}")
        (out,) = key_list("out_keys", out_keys, 1, 1)
        *where, name = out if isinstance(out, tuple) else (out,)
        self._settings = {"seed": seed, "dt": dt, "redraw_traits": redraw_traits}
        self._row_offset, self._models = row_offset, tuple(models)
        # A dummy reading gives the names of the models' states.
        one = torch.zeros(1, 2, dtype=torch.int64)
        moment = self._moment(one[0, :1], one, [])
        _, states = corrupt(self._models, torch.zeros(1, 1, 1), None, moment)
        self._states = [
            (i, remembered) for i, state in enumerate(states) for remembered in state
        ]
        names = ["clock", *(f"{i}_{remembered}" for i, remembered in self._states)]
        state_keys = [
            (*where, f"{name}_{n}") if where else f"{name}_{n}" for n in names
        ]
        super().__init__(in_keys, [out, *state_keys], state_keys)
        self.register_buffer("_masked", torch.empty(0, dtype=torch.int64), False)
        # The mask as given, until its length is checked.
        self._mask: Indices | None = None

    def restart(self, seed: int | None = None) -> None:
        """Start again at episode 0, from the next reset of all rows.

        Args:
            seed: New seed of all draws, as on construction; None keeps the old one.

        Raises:
            ValueError: If the seed is invalid.
        """
        if seed is not None:
            stream_key(seed, Stream.SENSOR)
            # Not in place: clones share the dictionary.
            self._settings = {**self._settings, "seed": seed}
        self._last = None

    def mask(self, sensors: Indices) -> None:
        """Mask some sensors: they read nothing. Replaces the previous mask.

        Without it, sensors that measure nothing still have false positives.

        Args:
            sensors: Indices of the masked sensors, or ``[S]`` bool. Whether they fit
                the number of sensors is checked at the next reading (ValueError).
        """
        self._masked = torch.tensor(
            indices(sensors), dtype=torch.int64, device=self._masked.device
        )
        self._mask = sensors

    def _moment(self, rows: Tensor, clock: Tensor, joint_vel: list[Tensor]) -> Moment:
        """Return the moment of some rows, from their clocks ``[B, 2]``."""
        if joint_vel:
            # The maximum, unlike the mean square, has no rounding.
            speed = joint_vel[0].abs().amax(-1)
        else:
            speed = torch.zeros(len(rows), device=rows.device)
        return Moment(
            row=rows + self._row_offset,
            episode=clock[:, 0],
            step=clock[:, 1],
            speed=speed,
            **self._settings,
        )

    def _run(
        self,
        rows: Tensor,
        inputs: Sequence[Tensor],
        clock: Tensor,
        remembered: Sequence[Tensor] | None,
    ) -> list[Tensor]:
        """Return reading, clock and states; ``remembered=None`` starts an episode."""
        distance, *joint_vel = inputs
        before = None
        if remembered is not None:
            before: list[State] | None = [{} for _ in self._models]
            for (i, name), value in zip(self._states, remembered, strict=True):
                before[i][name] = value
        reading, after = corrupt(
            self._models,
            # Distances [B, S] count as one beam per sensor.
            distance.reshape(*distance.shape[:2], distance.shape[2:].numel()),
            before,
            self._moment(rows, clock, joint_vel),
        )
        if self._mask is not None:
            indices(self._mask, distance.shape[1])
            self._mask = None
        if len(self._masked):
            # Specs are made of a dummy reading on the CPU.
            masked = self._masked.to(reading.device)
            reading = reading.index_fill(1, masked, torch.inf)
        values = [after[i][name] for i, name in self._states]
        return [reading.reshape(distance.shape), clock, *values]

    def start(
        self,
        rows: Tensor,
        inputs: Sequence[Tensor],
        before: Sequence[Tensor] | None,
    ) -> list[Tensor]:
        """Return the first reading of an episode, the clock and the models' states."""
        episode = torch.zeros_like(rows) if before is None else before[0][:, 0] + 1
        clock = torch.stack((episode, torch.zeros_like(episode)), -1)
        return self._run(rows, inputs, clock, None)

    def advance(
        self, rows: Tensor, inputs: Sequence[Tensor], state: Sequence[Tensor]
    ) -> list[Tensor]:
        """Return the next reading, the clock and the models' states."""
        clock, *remembered = state
        clock = torch.stack((clock[:, 0], clock[:, 1] + 1), -1)
        return self._run(rows, inputs, clock, remembered)

    def out_specs(self, spec: Composite) -> Sequence[TensorSpec]:
        """Return the specs of the reading, the clock and the models' states."""
        # On the CPU: the number of finite readings is unknown on "meta".
        return super().out_specs(spec.to("cpu"))
