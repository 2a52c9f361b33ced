"""The shape that the transforms of the project share, without state and with it.

Contract: a row of the result depends on the same row of the inputs, and of the state,
alone. On a partial reset only the rows that reset are computed; the environment fills
the others in.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs import Transform

from egoskin.robots.kinematics import pad_rows


class _KeyedTransform(Transform):
    """A transform that reads some keys and adds others to the observation."""

    def __init__(
        self, in_keys: Sequence[NestedKey], out_keys: Sequence[NestedKey]
    ) -> None:
        super().__init__(in_keys=list(in_keys), out_keys=list(out_keys))

    @abstractmethod
    def out_specs(self, spec: Composite) -> Sequence[TensorSpec]:
        """Return the spec of each out key, ``[*B, ...]``, from the input's spec."""

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Return the spec with the out keys added."""
        assert isinstance(observation_spec, Composite)
        try:
            specs = self.out_specs(observation_spec)
        except KeyError as error:
            held = sorted(map(str, observation_spec.keys(True)))
            raise KeyError(
                f"{type(self).__name__} needs {error}, which nothing before it writes; "
                f"the observation holds {held}"
            ) from error
        self._check_one_each("out_specs", specs)
        for key, spec in zip(self.out_keys, specs, strict=True):
            observation_spec[key] = spec
        return observation_spec

    def _read(
        self, tensordict: TensorDictBase, keys: Sequence[NestedKey]
    ) -> list[Tensor]:
        """Return entries with all batch dimensions made one, ``[B, ...]`` each."""
        missing = [k for k in keys if k not in tensordict.keys(True)]
        if missing:
            raise KeyError(
                f"{type(self).__name__} reads {missing[0]!r}, which the tensordict "
                f"lacks; it holds {sorted(map(str, tensordict.keys(True)))}"
            )
        batch = tensordict.batch_size
        values = [tensordict[key] for key in keys]
        if len(batch) == 1:
            return values
        return [x.reshape(-1, *x.shape[len(batch) :]) for x in values]

    def _write(self, tensordict: TensorDictBase, values: Sequence[Tensor]) -> None:
        """Set the out keys, from ``[B, ...]`` each."""
        batch = tensordict.batch_size
        for key, value in zip(self.out_keys, values, strict=True):
            tensordict.set(key, value.reshape(*batch, *value.shape[1:]))

    def _check_one_each(self, method: str, results: object) -> None:
        """Raise TypeError for a result that is not one for each out key.

        One tensor, or spec, alone would be taken for its rows.
        """
        if isinstance(results, tuple | list) and len(results) == len(self.out_keys):
            return
        name = type(results).__name__
        got = f"{name} of {len(results)}" if isinstance(results, Sequence) else name
        raise TypeError(
            f"{type(self).__name__}.{method} must return a tuple, one for each of "
            f"{self.out_keys}, got {got}"
        )

    def _rows_to_reset(
        self, tensordict: TensorDictBase, total: int
    ) -> tuple[Tensor, Tensor] | None:
        """Return the rows of a partial reset; None if all rows reset.

        Args:
            tensordict: What the reset was asked with; holds ``_reset [*B, 1]`` or not.
            total: Number of rows ``B``.

        Returns:
            The rows that reset ``[n]``, and the same padded: the rows to compute (at
            least one, so that shapes are known).
        """
        mask = tensordict.get("_reset", None)
        if mask is None or mask.all():
            return None
        rows = mask.reshape(total, -1).any(-1).nonzero()[:, 0]
        return rows, pad_rows(rows if len(rows) else rows.new_zeros(1))


def _spread(values: Tensor, rows: Tensor, total: int) -> Tensor:
    """Return values of some rows ``[n, ...]``, padded, in zeros ``[total, ...]``."""
    full = values.new_zeros(total, *values.shape[1:])
    full[rows] = values[: len(rows)]
    return full


class RowTransform(_KeyedTransform):
    """A TorchRL transform that maps each row of its inputs to a row of its outputs.

    Works inside a worker, around a ParallelEnv, and by calling it on any TensorDict
    with any leading dimensions (a stored batch with time, for example).

    Args:
        in_keys: Keys read; written only if they are out keys, too.
        out_keys: Keys written.
    """

    @abstractmethod
    def compute(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return one tensor for each out key, from one for each in key.

        Args:
            inputs: Tensors ``[B, ...]`` with a single batch dimension.

        Returns:
            Tensors ``[B, ...]``.
        """

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        inputs = self._read(next_tensordict, self.in_keys)
        self._write(next_tensordict, self._computed(inputs))
        return next_tensordict

    def _computed(self, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        values = self.compute(*inputs)
        self._check_one_each("compute", values)
        return values

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the out keys into any tensordict that holds the in keys."""
        return self._call(tensordict)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        total = tensordict_reset.batch_size.numel()
        partial = self._rows_to_reset(tensordict, total)
        if partial is None:
            return self._call(tensordict_reset)
        rows, index = partial
        inputs = self._read(tensordict_reset, self.in_keys)
        values = self._computed([x[index] for x in inputs])
        self._write(tensordict_reset, [_spread(x, rows, total) for x in values])
        return tensordict_reset


class StatefulTransform(_KeyedTransform):
    """A TorchRL transform whose results depend on its own earlier results.

    The state is some of the results. It lives in the tensordict (in the observation
    *and* in the state spec, so that it travels to workers and back), is never written
    in place, and starts anew in the rows that reset: from a stored tensordict
    everything continues bit for bit. Nothing downstream may exclude a state key.

    Works inside a worker, around a ParallelEnv, and by calling it on a stored
    TensorDict, see `forward`.

    Args:
        in_keys: Keys read; never written.
        out_keys: Keys written.
        state_keys: Those of the out keys that the next step reads back.
    """

    def __init__(
        self,
        in_keys: Sequence[NestedKey],
        out_keys: Sequence[NestedKey],
        state_keys: Sequence[NestedKey],
    ) -> None:
        super().__init__(in_keys, out_keys)
        assert set(state_keys) <= set(out_keys)
        self.state_keys = list(state_keys)
        # The state written last, as a reference. TorchRL tells a reset after a step
        # nothing but which rows reset; what ended there is known from here.
        self._last: list[Tensor] | None = None

    @abstractmethod
    def start(
        self,
        rows: Tensor,
        inputs: Sequence[Tensor],
        before: Sequence[Tensor] | None,
    ) -> Sequence[Tensor]:
        """Return the first values of an episode, one tensor for each out key.

        Args:
            rows: Which rows of this environment these are, ``[B]`` int64.
            inputs: One tensor ``[B, ...]`` for each in key.
            before: The state at the end of the episode before, one tensor
                ``[B, ...]`` for each state key; None before the first episode.

        Returns:
            Tensors ``[B, ...]``.
        """

    @abstractmethod
    def advance(
        self, rows: Tensor, inputs: Sequence[Tensor], state: Sequence[Tensor]
    ) -> Sequence[Tensor]:
        """Return the values of the next step, one tensor for each out key.

        Args:
            rows: Which rows of this environment these are, ``[B]`` int64.
            inputs: One tensor ``[B, ...]`` for each in key, of the next step.
            state: The state one step before, one tensor ``[B, ...]`` for each state
                key; not to be written to.

        Returns:
            Tensors ``[B, ...]``.
        """

    def transform_state_spec(self, state_spec: TensorSpec) -> TensorSpec:
        """Return the spec with the state keys added."""
        assert isinstance(state_spec, Composite)
        parent = self.parent
        assert parent is not None
        specs = self.out_specs(parent.observation_spec)
        for key, spec in zip(self.out_keys, specs, strict=True):
            if key in self.state_keys:
                state_spec[key] = spec
        return state_spec

    def _state_of(self, values: Sequence[Tensor]) -> list[Tensor]:
        """Return those of the values that are the state."""
        by_key = dict(zip(self.out_keys, values, strict=True))
        return [by_key[key] for key in self.state_keys]

    def _step(
        self, tensordict: TensorDictBase, next_tensordict: TensorDictBase
    ) -> TensorDictBase:
        inputs = self._read(next_tensordict, self.in_keys)
        state = self._read(tensordict, self.state_keys)
        rows = torch.arange(len(inputs[0]), device=inputs[0].device)
        values = self.advance(rows, inputs, state)
        self._last = self._state_of(values)
        self._write(next_tensordict, values)
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        total = tensordict_reset.batch_size.numel()
        inputs = self._read(tensordict_reset, self.in_keys)
        before = self._last
        if all(key in tensordict.keys(True) for key in self.state_keys):
            before = self._read(tensordict, self.state_keys)
        partial = self._rows_to_reset(tensordict, total)
        if partial is None:
            rows = torch.arange(total, device=inputs[0].device)
            values = self.start(rows, inputs, before)
        else:
            rows, index = partial
            ended = None if before is None else [x[index] for x in before]
            started = self.start(index, [x[index] for x in inputs], ended)
            values = [_spread(x, rows, total) for x in started]
        state = self._state_of(values)
        if partial is not None and before is not None:
            # The other rows keep theirs, for when they are reset.
            rows, _ = partial
            state = [
                old.index_copy(0, rows, new[rows])
                for old, new in zip(before, state, strict=True)
            ]
        self._last = state
        self._write(tensordict_reset, values)
        return tensordict_reset

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the out keys into a stored tensordict, step by step.

        Time is the last batch dimension, ``[*B, T]``. Episodes start at the first
        step and where ``is_init`` says so or, without it, after ``("next", "done")``.
        The entries under ``next`` stay as they are.

        Raises:
            ValueError: If there is no batch dimension.
            KeyError: If nothing tells where episodes start, or an in key is missing.
        """
        batch = tensordict.batch_size
        if not batch:
            raise ValueError(
                f"{type(self).__name__} needs steps in order: a tensordict whose last "
                "batch dimension is time, got one without a batch"
            )
        inputs = [
            x.reshape(-1, batch[-1], *x.shape[1:])
            for x in self._read(tensordict, self.in_keys)
        ]
        starts = _starts(tensordict)
        rows = torch.arange(len(starts), device=starts.device)
        state: list[Tensor] | None = None
        steps = []
        for t in range(batch[-1]):
            now = [x[:, t] for x in inputs]
            values = None if state is None else self.advance(rows, now, state)
            if values is None:
                values = self.start(rows, now, None)
            elif starts[:, t].any():
                values = [
                    torch.where(starts[:, t].reshape(-1, *[1] * (new.ndim - 1)), new, x)
                    for new, x in zip(self.start(rows, now, state), values, strict=True)
                ]
            state = self._state_of(values)
            steps.append(values)
        self._write(
            tensordict,
            [torch.stack(x, 1).flatten(0, 1) for x in zip(*steps, strict=True)],
        )
        return tensordict


def _starts(tensordict: TensorDictBase) -> Tensor:
    """Return which steps of a stored tensordict start an episode, ``[B, T]`` bool."""
    keys, time = tensordict.keys(True), tensordict.batch_size[-1]
    if "is_init" in keys:
        return tensordict["is_init"].reshape(-1, time)
    if ("next", "done") not in keys:
        raise KeyError(
            "where do episodes start? The tensordict holds neither 'is_init' nor "
            "('next', 'done')"
        )
    done = tensordict["next", "done"].reshape(-1, time)
    return torch.cat((torch.ones_like(done[:, :1]), done[:, :-1]), 1)
