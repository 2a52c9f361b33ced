"""Write a policy as ONNX, for a robot without PyTorch.

egoskin export field_proximity --out policy.onnx
egoskin export runs/NAME --to onnx --out policy.onnx
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

import egoskin.policies.export
from egoskin.commands.errors import check_packages
from egoskin.policies.export import export_onnx, needs_tracker, observation_parts
from egoskin.policies.policy import load_policy
from egoskin.runs.starts import git_state
from egoskin.storage.files import check_output, write_file


@dataclass(frozen=True, kw_only=True)
class ExportConfig:
    """Write a policy as one file that runs without PyTorch; docs/deploy.md says how."""

    policy: Annotated[Path, tyro.conf.Positional]
    """Run folder (its latest checkpoint), checkpoint, policy file, or the name of a
    policy that comes with the package."""
    out: Path
    """File to write, ``.onnx``."""
    to: Literal["onnx"] = "onnx"
    """Format: ONNX, opset 13, with all that a robot needs as JSON metadata."""

    def __post_init__(self) -> None:
        """Raise ValueError if the file cannot be written or a package is missing."""
        check_output(self.out, "--out", (".onnx",))
        check_packages("export", "export", "onnx", "onnxruntime")


def main(args: list[str]) -> None:
    """Run the command."""
    config = tyro.cli(ExportConfig, args=args)
    policy = load_policy(config.policy)
    git = git_state(Path(egoskin.policies.export.__file__))
    commit = None if git is None else git["commit"]
    content, difference = export_onnx(policy, commit)
    write_file(config.out, content)
    parts = observation_parts(policy)
    width = sum(part["width"] for part in parts)
    print(f"{config.out}: observation [1, {width}] -> action, {len(content):,} bytes")
    for part in parts:
        age = f", {part['age']} steps before" if part["age"] else ""
        print(f"  {part['name']:<16} {part['width']:5} {part['unit']}{age}")
    print(f"equal to PyTorch within {difference:.1e} x max(1, |action|)")
    if needs_tracker(policy):
        print(
            "egoskin.deploy refuses it: it reads positions of balls, which needs a "
            "tracker"
        )
