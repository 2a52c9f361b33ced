"""Definition of a study (cells, seeds, budget, evaluation) and its manifest file.

A study *describes* runs by the fields in which they differ from the default. Its
manifest *fixes* them: it stores the complete configuration at its creation, in the
format of that time, and each cell's differences from it. Later changes of defaults or
option names therefore do not affect a study that has begun.

Contract: cells and seeds can be added to a manifest; nothing in it is changed.
"""

from __future__ import annotations

import copy
import dataclasses
import fnmatch
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

from egoskin.bounds import COUNT, check_bounds
from egoskin.envs.standards import Standard, training_task
from egoskin.evaluation.throw_set import standard_task
from egoskin.hints import did_you_mean
from egoskin.make import AGENTS, EnvConfig
from egoskin.policies.policy import load_networks
from egoskin.rng import check_seed
from egoskin.robots.checks import check_trainable
from egoskin.runs.checks import check_effect, check_fits
from egoskin.runs.config import (
    INIT_HASH,
    MACHINE_FIELDS,
    RESUME_FIELDS,
    SKIN_HASH,
    TrainConfig,
)
from egoskin.sensors import Skin
from egoskin.storage.files import write_file
from egoskin.storage.formats import (
    content_hash,
    present_config,
    read_sealed,
    sealed_json,
)
from egoskin.storage.serialization import (
    changed_fields,
    from_plain,
    read_json,
    to_plain,
)
from egoskin.study.fields import (
    FILES,
    Overrides,
    brief,
    changed_values,
    get_value,
    override,
    set_value,
)

# Fields that a study sets itself, and fields that are the same in all its cells.
_NOT_OF_A_STUDY = RESUME_FIELDS | {"seed", "device", "engine"}
_OF_ALL_CELLS = {"snapshot_frames", "checkpoint_interval"}
# Longest name of a run [bytes]: file names, of at most 255 bytes, are longer than it.
_LONGEST_NAME = 200
# Fields that the sensor's label already contains.
_LABEL = ("env.sensor.coverage", "env.sensor.signal", "env.sensor.range")


@dataclass(frozen=True, kw_only=True)
class EvaluationPlan:
    """How the policy of each run is evaluated."""

    standard: Standard = "2"
    """Version of the standard throw."""
    throw_set: int = 1000
    """Seed of the throw set, which was not used for any tuning."""
    episodes: Annotated[int, AGENTS] = 4096
    """Throw sequences in the set."""
    masked: bool = True
    """Whether to evaluate it also with all its sensors masked."""

    def __post_init__(self) -> None:
        """Raise ValueError for invalid values."""
        check_seed(self.throw_set, "throw_set")
        check_bounds(self)


@dataclass(frozen=True, kw_only=True)
class Study:
    """Description of a study."""

    name: str
    """Name of the study."""
    purpose: str
    """Its purpose, in a few words."""
    cells: tuple[dict[str, Any], ...]
    """`egoskin.study.fields.Overrides` of each cell, and its ``name``, if wanted."""
    seeds: tuple[int, ...]
    """Seeds of each cell, in the order in which they are run."""
    frames: Annotated[int, COUNT]
    """Environment steps of each run."""
    standard: Standard = "2"
    """Version of the standard throw used in training."""
    base: dict[str, Any] = field(default_factory=dict)
    """`egoskin.study.fields.Overrides` that all cells share."""
    evaluation: EvaluationPlan = field(default_factory=EvaluationPlan)
    """How the policies are evaluated."""

    def __post_init__(self) -> None:
        """Raise ValueError for an empty study or invalid values."""
        if not self.cells or not self.seeds:
            raise ValueError(f"study {self.name}: needs at least one cell and one seed")
        if not re.fullmatch(r"[\w.-]+", self.name):
            raise ValueError(
                f"a study's name may only have letters, digits, '-', '_', '.', got "
                f"{self.name!r}"
            )
        for seed in self.seeds:
            check_seed(seed)
        if len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"study {self.name}: a seed is given twice: {self.seeds}")
        check_bounds(self)


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A cell of a manifest: runs that differ only in their seed."""

    name: str
    """Its own name, or one built from the fields in which it differs from the base."""
    config: TrainConfig
    """Its configuration, with seed 0."""
    skin_sha256: str
    """Hash of its skin."""
    init_sha256: str | None = None
    """Hash of the networks that its runs start from; None: new networks."""

    @property
    def hashes(self) -> dict[str, str]:
        """Hashes of the files that its results depend on, by their keys in a run."""
        found = {SKIN_HASH: self.skin_sha256, INIT_HASH: self.init_sha256}
        return {key: value for key, value in found.items() if value is not None}

    def among(self, cells: Iterable[Cell]) -> Cell | None:
        """Return the cell of some whose runs would be those of this one, if any."""
        runs = self.config, self.hashes
        return next((c for c in cells if (c.config, c.hashes) == runs), None)


@dataclass(frozen=True, kw_only=True)
class PlannedRun:
    """A run of a manifest."""

    cell: Cell
    """Its cell."""
    seed: int
    """Its seed."""

    @property
    def name(self) -> str:
        """Name of its folders."""
        return f"{self.cell.name}-seed{self.seed}"

    @property
    def config(self) -> TrainConfig:
        """Its configuration, with one worker and one learner thread."""
        return dataclasses.replace(
            self.cell.config, seed=self.seed, num_workers=1, learner_threads=1
        )

    @property
    def end(self) -> int:
        """Environment steps at its end, rounded up to whole rollouts."""
        config = self.cell.config
        size = config.frames_per_batch
        return math.ceil(config.total_frames / size) * size

    def differences(
        self, other: TrainConfig, hashes: Mapping[str, str] | None = None
    ) -> list[str]:
        """Return the names of the fields in which a configuration is not this run's.

        The length is not compared: a shorter run can be continued.

        Args:
            other: The configuration.
            hashes: Hashes of its files, by ``SKIN_HASH`` and ``INIT_HASH``; None: not
                compared. Their paths may differ.
        """
        old, new = to_plain(self.config), to_plain(other)
        moved = {n for n in FILES if None not in (get_value(old, n), get_value(new, n))}
        kept = RESUME_FIELDS | moved
        names = [n for n in changed_fields(old, new) if n not in kept]
        # Older runs and manifests lack some hashes.
        own, given = self.cell.hashes.items(), hashes or {}
        names += [key for key, value in own if given.get(key, value) != value]
        return [n.removeprefix("env.") for n in names]


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """The runs of a study, resolved and fixed."""

    study: str
    """Name of the study."""
    purpose: str
    """Its purpose."""
    base: TrainConfig
    """Configuration that the cells differ from."""
    cells: tuple[Cell, ...]
    """The cells, in the order in which they are run."""
    seeds: tuple[int, ...]
    """The seeds."""
    evaluation: EvaluationPlan
    """How the policies are evaluated."""

    @cached_property
    def runs(self) -> tuple[PlannedRun, ...]:
        """All runs: every cell with the first seed, then with the second, ..."""
        return tuple(PlannedRun(cell=c, seed=s) for s in self.seeds for c in self.cells)

    def run(self, name: str) -> PlannedRun:
        """Return the run with the given name.

        Raises:
            ValueError: If there is no such run; the text names the closest.
        """
        named = {run.name: run for run in self.runs}
        if name not in named:
            raise ValueError(f"no run {name!r}{did_you_mean(name, named)}")
        return named[name]

    def matching(self, patterns: Sequence[str]) -> tuple[PlannedRun, ...]:
        """Return the runs whose names match any of some shell patterns.

        Raises:
            ValueError: If a pattern matches no run; the text names the closest.
        """
        names = [run.name for run in self.runs]
        chosen = set()
        for pattern in patterns:
            found = fnmatch.filter(names, pattern)
            if not found:
                raise ValueError(f"no run {pattern!r}{did_you_mean(pattern, names)}")
            chosen.update(found)
        return tuple(run for run in self.runs if run.name in chosen)

    def overrides(self, cell: Cell) -> dict[str, Any]:
        """Return the values in which a cell differs from the base, by field."""
        return changed_values(self.base, cell.config)

    def not_default(self) -> dict[str, Any]:
        """Return the values in which all cells differ from the default, by field."""
        found = changed_values(TrainConfig(), self.base)
        return {k: v for k, v in found.items() if k not in MACHINE_FIELDS}

    def extended(self, other: Manifest) -> Manifest:
        """Return this manifest with the cells and seeds that another one adds.

        Raises:
            ValueError: If the other changes existing content.
        """
        for name in ("study", "evaluation"):
            own, new = getattr(self, name), getattr(other, name)
            if own != new:
                raise ValueError(
                    f"the manifest's {name} cannot be changed from {own} to {new}"
                )
        if changed := changed_values(self.base, other.base):
            raise ValueError(
                "the manifest's configuration cannot be changed; it differs in "
                + ", ".join(changed)
            )
        own = {cell.name: cell for cell in self.cells}
        for cell in other.cells:
            same = cell.among(own.values())
            if same is not None and same.name != cell.name:
                raise ValueError(
                    f"cell {cell.name} is the manifest's cell {same.name}: give it "
                    "that name"
                )
            before = own.setdefault(cell.name, cell)
            if before != cell:
                names = [*changed_values(before.config, cell.config)] or ["files"]
                raise ValueError(
                    f"the manifest's cell {cell.name} cannot be changed; it differs in "
                    + ", ".join(names)
                )
        seeds = dict.fromkeys((*self.seeds, *other.seeds))
        return dataclasses.replace(self, cells=tuple(own.values()), seeds=tuple(seeds))

    def save(self, path: Path) -> None:
        """Write the manifest."""
        content = {
            "study": self.study,
            "purpose": self.purpose,
            "seeds": list(self.seeds),
            "evaluation": to_plain(self.evaluation),
            "base": to_plain(self.base),
            "cells": [
                {
                    "name": cell.name,
                    "overrides": self.overrides(cell),
                    **cell.hashes,
                }
                for cell in self.cells
            ],
        }
        write_file(path, sealed_json(content))

    @classmethod
    def load(cls, path: Path) -> Manifest:
        """Return the manifest of a file, its configurations in the current format.

        Raises:
            ValueError: If it is not a manifest or has options that no longer exist.
        """
        if not path.is_file():
            raise ValueError(
                f"{path.parent} is not a study folder: it has no {path.name} (create "
                "one with: egoskin study plan NAME --dir FOLDER)"
            )
        content, number = read_sealed(path)
        what = str(path)

        def config(overrides: Overrides) -> TrainConfig:
            # Override in the format of the file, and only then migrate.
            plain = copy.deepcopy(content["base"])
            for name, value in overrides.items():
                set_value(plain, name, value, known=False)
            return from_plain(TrainConfig, present_config(plain, number, what), what)

        try:
            return cls(
                study=content["study"],
                purpose=content["purpose"],
                base=config({}),
                cells=tuple(
                    Cell(
                        name=cell["name"],
                        config=config(cell["overrides"]),
                        skin_sha256=cell[SKIN_HASH],
                        init_sha256=cell.get(INIT_HASH),
                    )
                    for cell in content["cells"]
                ),
                seeds=tuple(content["seeds"]),
                evaluation=from_plain(EvaluationPlan, content["evaluation"], what),
            )
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path} is not a study manifest: {error}") from error


def load_study(path: Path) -> Study:
    """Return the study of a JSON file with the fields of `Study`.

    Raises:
        ValueError: If it is not a valid study; the text names the field.
    """
    return from_plain(Study, read_json(path), str(path))


def resolve(study: Study) -> Manifest:
    """Return the manifest of a new study, with the current defaults.

    Raises:
        ValueError: If a cell is invalid or cannot start, or its name is too long or
            that of another; the text names the cell.
    """
    task = training_task(study.standard, TrainConfig().env.task)
    default = TrainConfig(env=EnvConfig(task=task), total_frames=study.frames)
    what = f"study {study.name}, base"
    base = override(default, study.base, what, _NOT_OF_A_STUDY - _OF_ALL_CELLS)
    skins: dict[Any, tuple[Skin, str]] = {}
    cells: dict[str, Cell] = {}
    for number, overrides in enumerate(study.cells, 1):
        what = f"study {study.name}, cell {number}"
        fields = {k: v for k, v in overrides.items() if k != "name"}
        config = override(base, fields, what, _NOT_OF_A_STUDY)
        key = (config.env.robot, config.env.skin)
        try:
            if key not in skins:
                skin = config.env.skin.build(config.env.robot_config)
                skins[key] = skin, content_hash(skin.to_dict())
            skin, digest = skins[key]
            check_trainable(config.env.robot_config)
            check_effect(config.env.sensor, skin)
            # These raise for sensors that do not fit each other, or the evaluation.
            config.env.pipeline(skin)
            standard_task(config.env, study.evaluation.standard)
            init = None
            if config.init_from is not None:
                initial = load_networks(config.init_from)
                init = content_hash({}, initial[0])
                check_fits(config, skin, initial)
        except (ValueError, OSError) as error:
            raise ValueError(f"{what}: {error}") from error
        cell = Cell(
            name=_own_name(overrides["name"], what)
            if "name" in overrides
            else cell_name(base, config),
            config=config,
            skin_sha256=digest,
            init_sha256=init,
        )
        seed = max(study.seeds)
        if (n := len(PlannedRun(cell=cell, seed=seed).name.encode())) > _LONGEST_NAME:
            raise ValueError(
                f"{what}: the names of its runs would have {n} bytes, and at most "
                f"{_LONGEST_NAME} are possible; set fields that all cells share in "
                "base, or give it a name"
            )
        if same := cell.among(cells.values()):
            both = f"{same.name} and {cell.name} are the same"
            if same.name == cell.name:
                both = f"cell {cell.name} is defined twice"
            raise ValueError(f"{what}: {both}")
        other = cells.setdefault(cell.name, cell)
        if other is not cell:
            differs = changed_values(other.config, config)
            names = ", ".join(name.removeprefix("env.") for name in differs)
            raise ValueError(
                f"{what}: another cell is also named {cell.name}; they only differ in "
                f"{names}: give one of them a name"
            )
    return Manifest(
        study=study.name,
        purpose=study.purpose,
        base=base,
        cells=tuple(cells.values()),
        seeds=tuple(study.seeds),
        evaluation=study.evaluation,
    )


def _own_name(name: Any, what: str) -> str:
    """Return the name that a study gives a cell.

    Raises:
        ValueError: If it cannot be part of a file's name.
    """
    if not isinstance(name, str) or not re.fullmatch(r"\w[\w.-]*", name):
        raise ValueError(
            f"{what}: a cell's name may only have letters, digits, '-', '_', '.', and "
            f"must not begin with '-' or '.', got {name!r}"
        )
    return name


def cell_name(base: TrainConfig, config: TrainConfig) -> str:
    """Return a cell's name: its sensor's label, then other differences to the base."""
    parts = [config.env.sensor.label()]
    for name, value in changed_values(base, config).items():
        if name in FILES and value is not None:
            value = Path(value).name
        if name not in _LABEL:
            # A minus sign, as "[-1.0, 1.0]" has, is not one of the hyphens.
            words = [name.rpartition(".")[2]]
            words += [re.sub(r"(?<!\w)-(?=\.?\d)", "minus", brief(value))]
            parts += [re.sub(r"[^\w.]+", "-", word).strip("-") for word in words]
    return "-".join(parts)
