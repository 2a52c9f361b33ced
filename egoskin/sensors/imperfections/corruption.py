"""Imperfect sensors: the transform that makes readings of true distances.

Imperfections (`egoskin.sensors.imperfections.models`) are frozen dataclasses that hold
their own parameters; `Corruption` applies a sequence of them to every reading of a
skin. Distances are metres; infinite means that nothing is in range, and NaN marks a
bad input and stays NaN.

Every draw is a function of (seed, global row, episode, step, model, reading): results
depend neither on the number of workers nor on which rows reset together.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded

from egoskin.rng import Stream, halfwords, random_words, stream_key
from egoskin.transform import StatefulTransform

State = dict[str, Tensor]
"""What a model remembers from step to step, by name, ``[B, ...]`` each."""

# Fourth word of a draw's counter: 24 bits of block, 2 of purpose, 6 of model.
_PURPOSE_BIT, _MODEL_BIT = 24, 26
_MAX_MODELS = 1 << (32 - _MODEL_BIT)


@dataclass(frozen=True, kw_only=True)
class Moment:
    """When readings are made and whose they are."""

    seed: int
    """Seed of all draws."""
    dt: float
    """Duration of a control step [s]."""
    row: Tensor
    """Global agent rows, ``[B]`` int64."""
    episode: Tensor
    """Episode of each row, ``[B]`` int64."""
    step: Tensor
    """Control steps since the start of the episode, ``[B]`` int64."""
    speed: Tensor
    """Speed of the fastest joint [rad/s], ``[B]``; 0 where no model asks for it."""
    redraw_traits: bool
    """Whether each row and episode has sensors of its own."""
    model: int = 0
    """Place of the model in the sequence: models share no draw."""

    def words(self, row: Tensor, block: Tensor, purpose: int = 0) -> Tensor:
        """Return four random words for each of some rows at this step.

        Args:
            row: Rows of this batch, ``[n]`` int64.
            block: Which words of the row, ``[n]`` int64 in [0, 2**24).
            purpose: What the model draws them for, in [0, 4).

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
        """The moment of draws that are constant: for what a sensor is."""
        # A step that no episode has, so that traits share no draw with a step.
        fixed = replace(self, step=torch.full_like(self.step, -1))
        if self.redraw_traits:
            return fixed
        zero = torch.zeros_like(self.row)
        return replace(fixed, row=zero, episode=zero)


class Places:
    """Some places in readings ``[B, S, K]``, and the random numbers drawn there.

    Args:
        row: Rows of this batch, ``[n]`` int64, ascending.
        place: Places in the flat ``[S, K]`` of the row, ``[n]`` int64, ascending
            within a row.
        beams: Beams of a sensor ``K``.
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
            purpose: What the model draws them for, in [0, 4).

        Returns:
            Numbers in [0, 2**16), ``[n]`` int64.
        """
        return _numbers(self._readings, moment, purpose)

    def draw_trait(self, moment: Moment, purpose: int = 0) -> Tensor:
        """Return a random number for the sensor of each place, for all its time.

        Args:
            moment: The moment of the readings.
            purpose: What the model draws them for, in [0, 4).

        Returns:
            Numbers in [0, 2**16), ``[n]`` int64.
        """
        calls = self._readings if self._beams == 1 else _calls(self.row, self.sensor)
        return _numbers(calls, moment.of_traits, purpose)

    def draw_common(self, moment: Moment) -> Tensor:
        """Return a random number for each place at this step, one for a whole row.

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
    """Return the calls of the generator that serve some places, and who is served.

    One call gives eight numbers, for eight neighbours, and is made where any of them
    needs one: most readings are infinite and need none.

    Args:
        row: Rows, ``[n]`` int64, ascending.
        place: Places in the row, ``[n]`` int64, ascending within a row.

    Returns:
        Row and block of each call ``[c]``; for each place which of the numbers of all
        calls it is given ``[n]``.
    """
    key = (row << _PURPOSE_BIT) + (place >> 3)
    calls, inverse = torch.unique_consecutive(key, return_inverse=True)
    row, block = calls >> _PURPOSE_BIT, calls & ((1 << _PURPOSE_BIT) - 1)
    return row, block, (inverse << 3) + (place & 7)


def _numbers(calls: tuple[Tensor, ...], moment: Moment, purpose: int) -> Tensor:
    """Return the 16-bit numbers of the places that the calls serve, ``[n]``."""
    row, block, number = calls
    return halfwords(moment.words(row, block, purpose)).take(number)


class Model:
    """One imperfection of a sensor: a frozen dataclass of its parameters."""

    per_speed: float = 0.0
    """Dependence on the speed of the fastest joint [s/rad], if the model has one."""


class PointModel(Model, ABC):
    """A model that changes finite readings, each for itself, and remembers nothing."""

    @abstractmethod
    def change(self, distance: Tensor, places: Places, moment: Moment) -> Tensor:
        """Return the changed distances [m], infinite for a reading of nothing, ``[n]``.

        Args:
            distance: Finite readings [m], ``[n]``.
            places: Where they are among the readings.
            moment: The moment of the readings.
        """


class FrameModel(Model, ABC):
    """A model of all readings of a moment together, which may remember."""

    def start(self, reading: Tensor, moment: Moment) -> State:
        """Return the state before the first reading of an episode.

        Args:
            reading: The first reading as it comes to this model [m], ``[B, S, K]``.
            moment: Its moment.
        """
        return {}

    @abstractmethod
    def apply(
        self, reading: Tensor, state: State, moment: Moment
    ) -> tuple[Tensor, State]:
        """Return what the model makes of readings, and its state after that.

        Args:
            reading: Distances [m], ``[B, S, K]``; not to be written to.
            state: The state after the reading before; not to be written to.
            moment: The moment of the readings.
        """


def find(reading: Tensor) -> tuple[Tensor, Places]:
    """Return the finite ones among readings ``[B, S, K]``, and where they are."""
    # Finite and not NaN, in one comparison.
    row, place = (reading.flatten(1) < torch.inf).nonzero(as_tuple=True)
    places = Places(row, place, reading.shape[2])
    return reading.take(places.index(reading.shape)), places


def put(reading: Tensor, places: Places, distance: Tensor) -> Tensor:
    """Return a copy of readings ``[B, S, K]`` with some places changed."""
    index = places.index(reading.shape)
    return reading.flatten().index_copy(0, index, distance).reshape(reading.shape)


class _Found:
    """The finite readings while point models change them, one after the other."""

    def __init__(self, reading: Tensor) -> None:
        self._reading = reading
        self._distance, self._places = find(reading)
        self._hidden = torch.zeros_like(self._distance, dtype=torch.bool)

    def change(self, model: PointModel, moment: Moment) -> None:
        """Let one more model change them."""
        changed = model.change(self._distance, self._places, moment)
        # Later models are given finite distances alone; what is gone stays gone.
        gone = changed == torch.inf
        self._hidden |= gone
        self._distance = torch.where(gone, self._distance, changed)

    def readings(self) -> Tensor:
        """Return all readings with the changed ones among them, ``[B, S, K]``."""
        distance = self._distance.masked_fill(self._hidden, torch.inf)
        return put(self._reading, self._places, distance)


def corrupt(
    models: Sequence[Model],
    distance: Tensor,
    states: Sequence[State] | None,
    moment: Moment,
) -> tuple[Tensor, list[State]]:
    """Return what models in sequence make of distances, and their states after that.

    Args:
        models: The models, in the order in which they apply.
        distance: True distances [m], ``[B, S, K]``; infinite where nothing is in
            range, NaN where the input was bad.
        states: The state of each model; None starts an episode.
        moment: The moment of the reading.

    Returns:
        Readings [m], not negative, ``[B, S, K]``; and one state for each model.
    """
    reading, after = distance, []
    # Found once for all point models in a row.
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
    [*B, J]`` [rad/s]. Writes ``reading``, like the distance and never negative;
    ``reading_clock [*B, 2]``, episode and step of each row; and for the i-th model
    ``reading_i_...``, what it remembers.

    Rows count from ``row_offset``: give each worker its own, and results do not
    depend on the number of workers. Episodes of a row count from 0 and go on from
    reset to reset. Two of these in one environment need two seeds.

    Args:
        models: What happens to a reading, in this order.
        dt: Duration of a control step [s].
        seed: Seed of all draws, in [0, 2**32).
        row_offset: Global index of the first row.
        redraw_traits: Whether each row and each episode has sensors of its own
            (offsets, gains, phases, which are dead), to train for any robot; or all
            have the same, those of the one robot that the seed stands for.
        in_keys: Keys of the distance and, if needed, of the joint velocities.
        out_keys: Key of the reading; the other keys take their names from it.

    Raises:
        ValueError: If the control step is not positive, the seed is none, there are
            too many models or the number of keys is wrong.
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
        if len(models) > _MAX_MODELS:
            raise ValueError(f"at most {_MAX_MODELS} models, got {len(models)}")
        needed = ["distance"]
        if any(model.per_speed > 0 for model in models):
            needed.append("joint_vel")
        if in_keys is not None and len(in_keys) != len(needed):
            raise ValueError(f"in_keys must name {', '.join(needed)}, got {in_keys}")
        (out,) = out_keys
        *where, name = out if isinstance(out, tuple) else (out,)
        self._settings = {"seed": seed, "dt": dt, "redraw_traits": redraw_traits}
        self._row_offset, self._models = row_offset, tuple(models)
        # What the models remember is known from any reading.
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
        super().__init__(in_keys or needed, [out, *state_keys], state_keys)

    def _moment(self, rows: Tensor, clock: Tensor, joint_vel: list[Tensor]) -> Moment:
        """Return the moment of some rows, from their clocks ``[B, 2]``."""
        if joint_vel:
            # The fastest joint and not the mean square: a maximum has no rounding.
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
        """Return reading, clock and what the models remember; None starts anew."""
        distance, *joint_vel = inputs
        before = None
        if remembered is not None:
            before: list[State] | None = [{} for _ in self._models]
            for (i, name), value in zip(self._states, remembered, strict=True):
                before[i][name] = value
        reading, after = corrupt(
            self._models,
            # Without beams, a sensor has one.
            distance.reshape(*distance.shape[:2], -1),
            before,
            self._moment(rows, clock, joint_vel),
        )
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
        return self._run(rows, inputs, clock + clock.new_tensor([0, 1]), remembered)

    def out_specs(self, spec: Composite) -> Sequence[TensorSpec]:
        """Return the specs of the reading, the clock and the models' states."""
        batch = spec.shape
        # Shapes are those of any reading.
        inputs = [
            torch.zeros(1, *spec[k].shape[len(batch) :], dtype=spec[k].dtype)
            for k in self.in_keys
        ]
        values = self.start(torch.zeros(1, dtype=torch.int64), inputs, None)
        return [
            Unbounded(
                shape=torch.Size((*batch, *value.shape[1:])),
                dtype=value.dtype,
                device=spec.device,
            )
            for value in values
        ]
