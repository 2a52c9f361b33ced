"""Data goes one way: who imports whom, read from the sources."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "egoskin"
MODULES = sorted(
    path.relative_to(PACKAGE).with_suffix("").as_posix().replace("/", ".")
    for path in PACKAGE.rglob("*.py")
)

# What each part may import of the package; a folder's name covers all it holds.
ALLOWED = {
    "files": set(),
    "bounds": set(),
    "chains": set(),
    "robots": {"files", "chains"},
    "compilation": set(),
    "rounding": set(),
    "events": set(),
    "sparse": set(),
    "shapes": {"rounding"},
    "draws": set(),
    "kinematics": {"rounding"},
    "surface": {"robots", "shapes", "kinematics"},
    "transform": {"kinematics"},
    "observations": {"kinematics", "transform"},
    "envs": {"bounds", "robots", "shapes", "draws", "kinematics", "surface", "envs"},
    "sensors": {
        "bounds",
        "files",
        "compilation",
        "rounding",
        "chains",
        "robots",
        "shapes",
        "draws",
        "kinematics",
        "surface",
        "transform",
        "sparse",
        "sensors",
    },
    "agents": {"bounds", "sparse", "agents"},
}
# The simulator, and what draws pictures of it.
MUJOCO = {
    "chains",
    "robots",
    "shapes",
    "envs.physics",
    "rendering",
    "sensors.mesh_surface",
}


def imports(module: str) -> set[str]:
    """Full names of all that a module imports, wherever the import stands."""
    path = PACKAGE / (module.replace(".", "/") + ".py")
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} imports relatively"
            assert node.module is not None
            # `from egoskin import x` may name a module as well as an object.
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
            names.add(node.module)
    return names


def part(name: str) -> str:
    """The part of the package that a full name belongs to: a module or a folder."""
    return name.split(".")[1]


@pytest.mark.parametrize("module", [m for m in MODULES if m.split(".")[0] in ALLOWED])
def test_a_module_imports_only_what_lies_before_it(module):
    names = imports(module)
    own = {part(name) for name in names if name.startswith("egoskin.")}
    assert own <= ALLOWED[module.split(".")[0]]
    # The public face of the package sees everything, so nothing may look at it.
    assert not any(name == "egoskin" for name in names)


@pytest.mark.parametrize("module", MODULES)
def test_the_simulator_is_imported_in_few_places(module):
    uses = any(name.split(".")[0] == "mujoco" for name in imports(module))
    assert not uses or module in MUJOCO


def test_the_layers_exist():
    parts = {module.split(".")[0] for module in MODULES}
    assert set(ALLOWED) <= parts
    assert MUJOCO - {"rendering"} <= set(MODULES)
