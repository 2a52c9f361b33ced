"""Code in the documents runs as it is given."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

import egoskin
from egoskin.policies.export import export_onnx

DEPLOY = Path(__file__).parents[1] / "docs" / "deploy.md"
CODE = re.findall(r"```python\n(.*?)```", DEPLOY.read_text(), re.DOTALL)

DRIVER = '''
from types import SimpleNamespace

import numpy as np


class Driver:
    """A robot that stands still; after three steps its skin stays silent."""

    def __init__(self, joints, kp, kd):
        assert len(joints) == len(kp) == len(kd) == 21
        self.targets = []

    def read_body(self):
        still = np.zeros(21)
        quat = np.array([1.0, 0.0, 0.0, 0.0])
        return SimpleNamespace(
            quat=quat, ang_vel=np.zeros(3), pos=still, vel=still, age=0.002
        )

    def read_skin(self):
        age = 0.02 if len(self.targets) < 3 else 0.5
        return SimpleNamespace(distance=np.full(64, np.inf), age=age)

    def send(self, target):
        assert target.shape == (21,)
        self.targets.append(target)

    def sleep_until_next(self, period):
        assert 0 < period < 0.1

    def damp(self):
        print(len(self.targets), "targets")
'''


def test_the_document_has_its_examples():
    assert len(CODE) == 4


SLOW = pytest.mark.slow
ALL = [0, *(pytest.param(number, marks=SLOW) for number in (1, 2, 3))]


@pytest.mark.parametrize("number", ALL)
def test_an_example_runs_as_given(number, tmp_path):
    (tmp_path / "my_robot.py").write_text(DRIVER)
    policy = egoskin.load_policy("field_proximity")
    (tmp_path / "policy.onnx").write_bytes(export_onnx(policy)[0])
    (tmp_path / "example.py").write_text(CODE[number])
    done = subprocess.run(
        [sys.executable, "example.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    said = re.findall(r"print\(.*#(.*)", CODE[number])
    if number == 0:
        said = ["the distances of the skin are 0.5 s old", "4 targets"]
    lines = [line.strip() for line in done.stdout.splitlines() if "torchrl" not in line]
    assert lines == [line.strip() for line in said]
