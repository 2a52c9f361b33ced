"""Layering: allowed imports between packages, checked in the sources."""

from __future__ import annotations

import ast
from pathlib import Path

import egoskin

PACKAGE = Path(egoskin.__file__).parent
MODULES = {
    path.relative_to(PACKAGE).with_suffix("").as_posix().replace("/", "."): path
    for path in PACKAGE.rglob("*.py")
}

# Small modules that many packages share; the last ones import those before them.
TOOLS = [
    "hints",
    "bounds",
    "cgroups",
    "memory",
    "gpu",
    "gradients",
    "rounding",
    "warp_philox",
    "rng",
    "sparse",
    "progress",
    "interrupts",
    "parallel",
    "shapes",
]
# Allowed imports of each package besides the tools; no two import each other.
ROOMS = {
    "storage": set(),
    "robots": {"storage"},
    "transform": set(),
    "envs": {"robots", "transform"},
    "sensors": {"storage", "robots", "transform"},
    "agents": set(),
    "make": {"storage", "robots", "transform", "envs", "sensors"},
    "policies": {"storage", "envs", "sensors", "agents", "make"},
    "evaluation": {"robots", "transform", "envs", "sensors", "policies", "make"},
    "runs": {"storage", "robots", "envs", "sensors", "agents", "make", "policies"},
    "deploy": set(),
    "viewer": {
        *("storage", "robots", "envs", "sensors", "make", "policies", "evaluation")
    },
    "gym": {"storage", "make", "viewer"},
    "study": {
        *("storage", "robots", "envs", "sensors", "agents", "make", "policies"),
        *("evaluation", "runs"),
    },
}
# All but the public face: nothing imports what the command line does.
TOP = "commands"
# The simulator, and what draws pictures of it.
MUJOCO = {
    "robots.chains",
    "robots.config",
    "robots.meshes",
    "robots.model",
    "robots.portable",
    "robots.spec",
    "shapes",
    "envs.physics.model",
    "envs.physics.mujoco",
    "sensors.skin.mesh_surface",
    "viewer.offscreen",
    "viewer.web.body",
    # Commands are refused where it cannot be imported; benchmarks measure it alone.
    "commands.__init__",
    "commands.bench.accuracy",
    "commands.bench.physics",
}


def imports(module: str) -> set[str]:
    """Full names of all that a module imports, wherever the import stands."""
    names = set()
    for node in ast.walk(ast.parse(MODULES[module].read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} imports relatively"
            assert node.module is not None
            # `from egoskin import x` may name a module as well as an object.
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
            names.add(node.module)
    return names


def rooms(module: str) -> set[str]:
    """Rooms and tools of the package that a module imports, its own left out."""
    own = {name.split(".")[1] for name in imports(module) if name[:8] == "egoskin."}
    return own - {module.split(".")[0]}


def test_a_room_imports_only_rooms_before_it():
    wrong = {
        module: strange
        for module in MODULES
        if (room := module.split(".")[0]) in ROOMS
        and (strange := rooms(module) - ROOMS[room] - set(TOOLS))
    }
    assert not wrong


def test_a_tool_imports_only_tools_before_it():
    for number, tool in enumerate(TOOLS):
        assert rooms(tool) <= set(TOOLS[:number]), tool


def test_no_two_rooms_import_each_other():
    ready, left = set(TOOLS), dict(ROOMS)
    while left:
        free = [room for room, needs in left.items() if needs <= ready]
        assert free, f"a circle among {sorted(left)}"
        ready |= set(free)
        for room in free:
            del left[room]


def test_the_public_face_is_imported_by_the_command_line_alone():
    users = {m for m in MODULES if m != "__init__" and "egoskin" in imports(m)}
    assert users == {f"{TOP}.__init__"}


def test_the_command_line_is_imported_by_nothing():
    users = {module for module in MODULES if TOP in rooms(module)}
    assert users == {"__main__"}


def test_the_simulator_is_imported_in_few_places():
    uses = {
        module
        for module in MODULES
        if any(name.split(".")[0] == "mujoco" for name in imports(module))
    }
    assert uses == MUJOCO


def test_only_the_room_of_the_engines_names_one():
    engines = {f"egoskin.{m}" for m in MODULES if m.startswith("envs.physics.")}
    shared = ("contract", "model", "__init__")
    engines -= {f"egoskin.envs.physics.{name}" for name in shared}
    # Benchmarks may name engines, and an engine its own parts.
    naming = {m for m in MODULES if engines & imports(m) and ".bench." not in m}
    naming -= {name.removeprefix("egoskin.") for name in engines}
    assert naming == {"envs.physics.__init__"}
