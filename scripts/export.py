"""Write a policy as ONNX, for a robot without PyTorch.

The same as `egoskin export`:
python scripts/export.py runs/NAME --out policy.onnx
"""

from __future__ import annotations

from egoskin.commands import run

if __name__ == "__main__":
    run("export")
