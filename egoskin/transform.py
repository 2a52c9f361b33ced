"""Base classes of the project's TorchRL transforms, with and without state.

Contract: a row of the result depends only on the same row of the inputs and of the
state. On a partial reset the environment takes only the rows that reset. On the CPU the
others are not computed, but keep their last values, for transforms with statistics of
all rows (`VecNormV2`); a GPU computes all, if they have no state, because it would
otherwise wait until the host has counted the rows.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterable, Sequence
from itertools import repeat
from typing import TYPE_CHECKING

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec, Unbounded
from torchrl.envs import Compose, Transform, TransformedEnv

from egoskin.rounding import pad_rows

if TYPE_CHECKING:
    from typing_extensions import Self


def key_list(
    name: str, keys: Sequence[NestedKey], least: int = 0, most: int | None = None
) -> list[NestedKey]:
    """Return keys as a list.

    Args:
        name: Name of the argument that holds them, for the error text.
        keys: The keys.
        least: Number that is needed.
        most: Number that is allowed; None: any.

    Raises:
        ValueError: If they are not a list of keys, or too few or too many.
    """
    if isinstance(keys, str) or not isinstance(keys, Iterable):
        raise ValueError(f"{name} must be a list of keys, got {keys!r}")
    keys = list(keys)
    if len(keys) < least or (most is not None and len(keys) > most):
        number = {least: f"{least}", None: f"at least {least}"}.get(most)
        number = number or f"{least} to {most}"
        raise ValueError(f"{name} must be a list of {number}, got {keys}")
    return keys


class _KeyedTransform(Transform):
    """A transform that reads some keys and adds others to the observation.

    A subclass states how many keys it needs and how many it allows (None: any).
    """

    _NUM_IN: tuple[int, int | None] = (0, None)
    _NUM_OUT: tuple[int, int | None] = (0, None)

    def __init__(
        self, in_keys: Sequence[NestedKey], out_keys: Sequence[NestedKey]
    ) -> None:
        super().__init__(
            in_keys=key_list("in_keys", in_keys, *self._NUM_IN),
            out_keys=key_list("out_keys", out_keys, *self._NUM_OUT),
        )
        # Reference to the last values written in an environment.
        self._written: Sequence[Tensor] | None = None

    def clone(self) -> Self:
        """Return a copy for another environment, which shares nothing that changes."""
        new = super().clone()
        new._written = None
        for name, buffer in self.named_buffers(recurse=False):
            # Not registered again, which would add it to the state dict of both.
            setattr(new, name, buffer.clone())
        return new

    def out_specs(self, spec: Composite) -> Sequence[TensorSpec]:
        """Return the spec of each out key, ``[*B, ...]``, given the input spec.

        By default unbounded, with the shapes and types computed from a row of zeros.
        """
        batch = spec.shape
        zeros = [
            torch.zeros(
                (1, *spec[key].shape[len(batch) :]),
                dtype=spec[key].dtype,
                device=spec.device,
            )
            for key in self.in_keys
        ]
        with torch.no_grad():
            values = self._first(zeros)
        return [
            (Binary if value.dtype == torch.bool else Unbounded)(
                shape=torch.Size((*batch, *value.shape[1:])), dtype=value.dtype
            )
            for value in values
        ]

    @abstractmethod
    def _first(self, inputs: Sequence[Tensor]) -> Sequence[Tensor]:
        """Return the first values of an episode of one row, ``[1, ...]`` each."""

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
            if key in observation_spec.keys(True) and key not in self.in_keys:
                raise ValueError(
                    f"{type(self).__name__} would overwrite {key!r}, which it does not "
                    "read, and which the environment or a transform before it writes: "
                    "give one of them out_keys of its own"
                )
            observation_spec[key] = _on_device_of(observation_spec, spec)
        return observation_spec

    def _read(
        self, tensordict: TensorDictBase, keys: Sequence[NestedKey]
    ) -> list[Tensor]:
        """Return entries with all batch dimensions flattened, ``[B, ...]`` each."""
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
        # Not -1, which is ambiguous for an entry without numbers.
        return [x.reshape(batch.numel(), *x.shape[len(batch) :]) for x in values]

    def _write(self, tensordict: TensorDictBase, values: Sequence[Tensor]) -> None:
        """Write the values, ``[B, ...]`` each, to the out keys."""
        batch = tensordict.batch_size
        for key, value in zip(self.out_keys, values, strict=True):
            tensordict.set(key, value.reshape(*batch, *value.shape[1:]))

    def _write_rows(
        self,
        tensordict: TensorDictBase,
        values: Sequence[Tensor],
        rows: Tensor | None = None,
    ) -> None:
        """Write the values of all rows or, padded, of some; the others are the last."""
        if rows is not None:
            total, last = tensordict.batch_size.numel(), self._written or repeat(None)
            values = [
                _spread(new, rows, total, old)
                for new, old in zip(values, last, strict=False)
            ]
        self._written = [value.detach() for value in values]
        self._write(tensordict, values)

    def _valid(
        self, method: str, values: Sequence[Tensor], rows: int
    ) -> Sequence[Tensor]:
        """Return a method's results; raise unless there is a row for each input row."""
        self._check_one_each(method, values)
        for key, value in zip(self.out_keys, values, strict=True):
            if not value.ndim or len(value) != rows:
                raise ValueError(
                    f"{type(self).__name__}.{method} must return a row for each of the "
                    f"{rows} rows of its inputs, got {list(value.shape)} for {key!r}"
                )
        return values

    def _check_one_each(self, method: str, results: object) -> None:
        """Raise TypeError unless there is one result for each out key.

        A single tensor or spec would otherwise be iterated over its rows.
        """
        if isinstance(results, tuple | list) and len(results) == len(self.out_keys):
            return
        name = type(results).__name__
        got = f"{name} of {len(results)}" if isinstance(results, Sequence) else name
        raise TypeError(
            f"{type(self).__name__}.{method} must return a tuple with one entry for "
            f"each of {self.out_keys}, got {got}"
        )

    def _rows_to_reset(
        self, tensordict: TensorDictBase, total: int
    ) -> tuple[Tensor, Tensor] | None:
        """Return the rows of a partial reset; None if all rows reset.

        Args:
            tensordict: Input of the reset, with or without ``_reset [*B, 1]``.
            total: Number of rows ``B``.

        Returns:
            The rows that reset ``[n]``, and the same rows padded, which are the rows to
            compute (at least one, so that shapes are known).
        """
        mask = tensordict.get("_reset", None)
        if mask is None or mask.all():
            return None
        rows = mask.reshape(total, -1).any(-1).nonzero()[:, 0]
        return rows, pad_rows(rows if len(rows) else rows.new_zeros(1))


def _after(chain: Transform, one: Transform) -> list[Transform]:
    """Return the transforms of a chain that come after one of them."""
    parts = iter(_parts(chain))
    # Consumes the iterator up to that one; all of it if a wrapper hides that one.
    any(part is one for part in parts)
    return list(parts)


def _parts(chain: Transform) -> list[Transform]:
    """Return the transforms of a chain, in order."""
    if isinstance(chain, Compose):
        return [part for link in chain for part in _parts(link)]
    return [chain]


def _on_device_of(spec: Composite, own: TensorSpec) -> TensorSpec:
    """Return a spec on the device of the spec that it becomes an entry of."""
    return own if spec.device is None else own.to(spec.device)


def _on_gpu(tensordict: TensorDictBase) -> bool:
    return tensordict.device is not None and tensordict.device.type != "cpu"


def _spread(values: Tensor, rows: Tensor, total: int, last: Tensor | None) -> Tensor:
    """Return padded values of some rows ``[n, ...]`` among the last of all rows.

    Without last values ``[total, ...]`` of this kind, the other rows are zero.
    """
    shape = torch.Size((total, *values.shape[1:]))
    kind = (shape, values.dtype, values.device)
    if last is None or (last.shape, last.dtype, last.device) != kind:
        last = values.new_zeros(shape)
    return last.index_copy(0, rows, values[: len(rows)])


class RowTransform(_KeyedTransform):
    """A TorchRL transform that maps each row of its inputs to a row of its outputs.

    It works inside a worker, around a ParallelEnv, and when called on a TensorDict with
    any leading dimensions (for example, a stored batch with time). Keys may be nested,
    but the batch is that of the whole TensorDict: further batch dimensions of a nested
    one (several agents, say) are not supported. The specs of the out keys are computed
    from a row of zeros; override ``out_specs`` for others, such as bounded ones.

    Args:
        in_keys: Keys read; written only if they are also out keys.
        out_keys: Keys written.

    Raises:
        ValueError: If the keys are not a list.
    """

    @abstractmethod
    def compute(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Compute one tensor per out key from one tensor per in key.

        Args:
            inputs: Tensors ``[B, ...]`` with a single batch dimension.

        Returns:
            Tensors ``[B, ...]``.
        """

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        inputs = self._read(next_tensordict, self.in_keys)
        self._write_rows(next_tensordict, self._computed(inputs))
        return next_tensordict

    def _first(self, inputs: Sequence[Tensor]) -> Sequence[Tensor]:
        return self._computed(inputs)

    def _computed(self, inputs: Sequence[Tensor]) -> Sequence[Tensor]:
        return self._valid("compute", self.compute(*inputs), len(inputs[0]))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the out keys into any tensordict that holds the in keys."""
        self._write(tensordict, self._computed(self._read(tensordict, self.in_keys)))
        return tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        if _on_gpu(tensordict_reset):
            return self._call(tensordict_reset)
        total = tensordict_reset.batch_size.numel()
        partial = self._rows_to_reset(tensordict, total)
        if partial is None:
            return self._call(tensordict_reset)
        rows, index = partial
        inputs = self._read(tensordict_reset, self.in_keys)
        values = self._computed([x[index] for x in inputs])
        self._write_rows(tensordict_reset, values, rows)
        return tensordict_reset


class StatefulTransform(_KeyedTransform):
    """A TorchRL transform whose results depend on its own earlier results.

    The state is a subset of the results. It is kept in the tensordict (in the
    observation *and* in the state spec, so that it is sent to workers and back), is
    never written in place, and is initialised again in rows that reset. Everything
    continues bit for bit from a stored tensordict. Later transforms must neither drop
    nor change a state key: give `ObservationNorm` out keys of its own.

    It works inside a worker, around a ParallelEnv, and when called on a stored
    TensorDict, see `forward`.

    Args:
        in_keys: Keys read; never written.
        out_keys: Keys written.
        state_keys: The out keys that the next step reads back.

    Raises:
        ValueError: If the keys are not lists, or a state key is no out key.
    """

    def __init__(
        self,
        in_keys: Sequence[NestedKey],
        out_keys: Sequence[NestedKey],
        state_keys: Sequence[NestedKey],
    ) -> None:
        super().__init__(in_keys, out_keys)
        self.state_keys = key_list("state_keys", state_keys)
        if others := [key for key in self.state_keys if key not in self.out_keys]:
            raise ValueError(
                f"state_keys must be among the out_keys, {self.out_keys}; not so: "
                f"{others}"
            )
        # Reference to the last state written. On a reset after a step, TorchRL only
        # passes which rows reset; this is the state at the end of their episodes.
        self._last: list[Tensor] | None = None
        # Observation spec of the environment that was found to hold the state keys.
        self._checked: TensorSpec | None = None

    def clone(self) -> Self:
        """Return a copy for another environment, where it starts at the beginning."""
        new = super().clone()
        new._last = None
        new._checked = None
        return new

    @abstractmethod
    def start(
        self,
        rows: Tensor,
        inputs: Sequence[Tensor],
        before: Sequence[Tensor] | None,
    ) -> Sequence[Tensor]:
        """Return the first values of an episode, one tensor for each out key.

        Args:
            rows: Indices of the rows in this environment, ``[B]`` int64.
            inputs: One tensor ``[B, ...]`` for each in key.
            before: The state at the end of the previous episode, one tensor
                ``[B, ...]`` for each state key; None for the first episode.

        Returns:
            Tensors ``[B, ...]``.
        """

    @abstractmethod
    def advance(
        self, rows: Tensor, inputs: Sequence[Tensor], state: Sequence[Tensor]
    ) -> Sequence[Tensor]:
        """Return the values of the next step, one tensor for each out key.

        Args:
            rows: Indices of the rows in this environment, ``[B]`` int64.
            inputs: One tensor ``[B, ...]`` for each in key, of the next step.
            state: The state of the previous step, one tensor ``[B, ...]`` for each
                state key; must not be modified.

        Returns:
            Tensors ``[B, ...]``.
        """

    def _first(self, inputs: Sequence[Tensor]) -> Sequence[Tensor]:
        row = torch.zeros(1, dtype=torch.int64, device=inputs[0].device)
        return self._started(row, inputs, None)

    def _started(
        self,
        rows: Tensor,
        inputs: Sequence[Tensor],
        before: Sequence[Tensor] | None,
    ) -> Sequence[Tensor]:
        return self._valid("start", self.start(rows, inputs, before), len(rows))

    def _advanced(
        self, rows: Tensor, inputs: Sequence[Tensor], state: Sequence[Tensor]
    ) -> Sequence[Tensor]:
        return self._valid("advance", self.advance(rows, inputs, state), len(rows))

    def transform_state_spec(self, state_spec: TensorSpec) -> TensorSpec:
        """Return the spec with the state keys added."""
        assert isinstance(state_spec, Composite)
        parent = self.parent
        assert parent is not None
        specs = self.out_specs(parent.observation_spec)
        for key, spec in zip(self.out_keys, specs, strict=True):
            if key in self.state_keys:
                state_spec[key] = _on_device_of(state_spec, spec)
        return state_spec

    def _check_kept(self) -> None:
        """Raise ValueError if a later transform drops or changes a state key.

        TorchRL would give every step the state of the last reset, or the changed state.
        """
        env = self.container
        if env is None or env.observation_spec is self._checked:
            return
        held = env.observation_spec.keys(True)
        if dropped := [key for key in self.state_keys if key not in held]:
            raise ValueError(
                f"a transform after {type(self).__name__} drops {dropped}, which the "
                f"next step reads back: keep its state_keys, {self.state_keys}"
            )
        chain = env.transform if isinstance(env, TransformedEnv) else self
        for other in _after(chain, self):
            if changed := [k for k in self.state_keys if k in (other.out_keys or ())]:
                raise ValueError(
                    f"{type(other).__name__} after {type(self).__name__} changes "
                    f"{changed}, which the next step reads back: give it out_keys of "
                    "its own"
                )
        self._checked = env.observation_spec

    def _state_of(self, values: Sequence[Tensor]) -> list[Tensor]:
        """Return the values of the state keys."""
        by_key = dict(zip(self.out_keys, values, strict=True))
        return [by_key[key] for key in self.state_keys]

    def _step(
        self, tensordict: TensorDictBase, next_tensordict: TensorDictBase
    ) -> TensorDictBase:
        inputs = self._read(next_tensordict, self.in_keys)
        state = self._read(tensordict, self.state_keys)
        rows = torch.arange(len(inputs[0]), device=inputs[0].device)
        values = self._advanced(rows, inputs, state)
        self._last = self._state_of(values)
        self._write_rows(next_tensordict, values)
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self._check_kept()
        total = tensordict_reset.batch_size.numel()
        inputs = self._read(tensordict_reset, self.in_keys)
        before = self._last
        if all(key in tensordict.keys(True) for key in self.state_keys):
            before = self._read(tensordict, self.state_keys)
        partial = self._rows_to_reset(tensordict, total)
        if partial is None:
            every = torch.arange(total, device=inputs[0].device)
            values = self._started(every, inputs, before)
            self._last = self._state_of(values)
            self._write_rows(tensordict_reset, values)
            return tensordict_reset
        rows, index = partial
        ended = None if before is None else [x[index] for x in before]
        values = self._started(index, [x[index] for x in inputs], ended)
        # The other rows keep their state until they are reset.
        self._last = [
            _spread(new, rows, total, old)
            for new, old in zip(
                self._state_of(values), before or repeat(None), strict=False
            )
        ]
        self._write_rows(tensordict_reset, values, rows)
        return tensordict_reset

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        """Start the rows that the environment itself has reset in its step."""
        partial = self._rows_to_reset(tensordict, tensordict_reset.batch_size.numel())
        before = self._read(tensordict_reset, self.out_keys)
        self._reset(tensordict, tensordict_reset)
        if partial is not None:
            # Nobody else merges the rows that do not reset.
            rows, _ = partial
            values = self._read(tensordict_reset, self.out_keys)
            values = [
                old.index_copy(0, rows, new[rows])
                for old, new in zip(before, values, strict=True)
            ]
            self._write(tensordict_reset, values)
        return tensordict_reset

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the out keys into a stored tensordict, step by step.

        Time is the last batch dimension, ``[*B, T]``. Episodes start at the first
        step and where ``is_init`` is true or, without it, after ``("next", "done")``.
        The entries under ``next`` are not changed.

        Raises:
            ValueError: If there is no batch dimension, or no step.
            KeyError: If ``is_init`` and ``done`` are both missing, or an in key is.
        """
        batch = tensordict.batch_size
        if not batch:
            raise ValueError(
                f"{type(self).__name__} needs steps in order: a tensordict whose last "
                "batch dimension is time, got one without a batch"
            )
        if not batch[-1]:
            raise ValueError(
                f"{type(self).__name__} needs at least one step, got {list(batch)}"
            )
        inputs = [
            x.reshape(batch[:-1].numel(), batch[-1], *x.shape[1:])
            for x in self._read(tensordict, self.in_keys)
        ]
        starts = _starts(tensordict)
        rows = torch.arange(len(starts), device=starts.device)
        state: list[Tensor] | None = None
        steps = []
        for t in range(batch[-1]):
            now = [x[:, t] for x in inputs]
            values = None if state is None else self._advanced(rows, now, state)
            if values is None:
                values = self._started(rows, now, None)
            elif starts[:, t].any():
                values = [
                    torch.where(starts[:, t].reshape(-1, *[1] * (new.ndim - 1)), new, x)
                    for new, x in zip(
                        self._started(rows, now, state), values, strict=True
                    )
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
    keys, (*before, time) = tensordict.keys(True), tensordict.batch_size
    shape = (math.prod(before), time)
    if "is_init" in keys:
        return tensordict["is_init"].reshape(shape)
    if ("next", "done") not in keys:
        raise KeyError(
            "unknown starts of episodes: the tensordict has neither 'is_init' nor "
            "('next', 'done')"
        )
    done = tensordict["next", "done"].reshape(shape)
    return torch.cat((torch.ones_like(done[:, :1]), done[:, :-1]), 1)
