"""Limits of control groups, of both versions, in trees made for a test."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from egoskin import cgroups
from egoskin.cgroups import cpu_limit, memory_limit

BATCH = "/slurm/job_7/step_0"
Write = Callable[[dict[str, str]], None]


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Write:
    """Writes files of control groups; ``own`` lists the groups of this process."""
    monkeypatch.setattr(cgroups, "_OWN", tmp_path / "own")
    monkeypatch.setattr(cgroups, "_TREES", tmp_path / "trees")

    def write(files: dict[str, str]) -> None:
        for name, text in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text + "\n")

    return write


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({"cpu.max": "max 100000"}, None),
        ({"cpu.max": "150000 100000"}, 1.5),
        ({"slurm/job_7/step_0/cpu.max": "400000 100000"}, 4),
        # A group gets no more than one above it.
        (
            {
                "slurm/job_7/step_0/cpu.max": "max 100000",
                "slurm/job_7/cpu.max": "100000 50000",
                "slurm/cpu.max": "6400000 100000",
            },
            2,
        ),
        ({"slurm/job_8/cpu.max": "100000 100000"}, None),
    ],
)
def test_cpu_time_in_version_2(files, cores, write):
    write({f"trees/{name}": text for name, text in files.items()})
    write({"own": f"0::{BATCH}"})
    assert cpu_limit() == cores


@pytest.mark.parametrize(("quota", "cores"), [("-1", None), ("250000", 2.5)])
def test_cpu_time_in_version_1(quota, cores, write):
    write(
        {
            "own": f"5:cpuset:/\n4:cpu,cpuacct:{BATCH}\n1:name=systemd:/\n0::/",
            "trees/cpu/slurm/job_7/cpu.cfs_quota_us": quota,
            "trees/cpu/slurm/job_7/cpu.cfs_period_us": "100000",
            "trees/cpuset/cpu.cfs_quota_us": "1",
            "trees/cpuset/cpu.cfs_period_us": "100000",
        }
    )
    assert cpu_limit() == cores


def test_memory_is_that_of_the_smallest_group(write):
    write({"own": f"0::{BATCH}", "trees/slurm/job_7/step_0/memory.max": "max"})
    assert memory_limit() is None
    write({"trees/slurm/job_7/memory.max": "4000000000"})
    write({"trees/slurm/memory.max": "64000000000"})
    assert memory_limit() == 4_000_000_000
    # Version 1, in a container: its groups are known by names outside of it.
    write({"own": "7:memory:/docker/4f2a\n0::/docker/4f2a"})
    write({"trees/memory/memory.limit_in_bytes": "3000000000"})
    assert memory_limit() == 3_000_000_000


def test_a_system_without_control_groups_has_no_limits(write):
    assert cpu_limit() is None
    assert memory_limit() is None
