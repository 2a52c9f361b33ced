"""A robot's model as text that may come from a stranger: data, and the robot alone.

Contract: MuJoCo is given what was looked through, element by element, written anew; so
a model names no other file, and nothing in it is run.
"""

from __future__ import annotations

from xml.etree import ElementTree

# All that a robot of primitives is made of. None of them names a file or a plugin.
_ELEMENTS = frozenset(
    (
        *("mujoco", "compiler", "option", "flag", "default", "asset", "material"),
        *("worldbody", "body", "inertial", "joint", "freejoint", "geom", "site"),
        *("contact", "exclude", "pair"),
    )
)
_LONGEST, _DEEPEST = 2**20, 200


def checked_model(text: str, what: str) -> str:
    """Return an MJCF as MuJoCo may read it, whoever wrote it.

    Args:
        text: The MJCF.
        what: Whose it is, for the error text.

    Raises:
        ValueError: If it is no MJCF, or holds more than a robot of primitives.
    """
    if len(text) > _LONGEST:
        raise ValueError(f"{what}: its model is longer than {_LONGEST:,} characters")
    # Entities could name files, or grow without bounds.
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError(f"{what}: its model declares a document type, as none may")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"{what}: its model is no XML: {error}") from error
    if root.tag != "mujoco":
        raise ValueError(f"{what}: its model must be <mujoco>, not <{root.tag}>")
    level, depth = [root], 0
    while level:
        for element in level:
            if element.tag not in _ELEMENTS:
                raise ValueError(
                    f"{what}: its model holds <{element.tag}>: a robot that is kept as "
                    "data is made of bodies, joints and primitives, and names no file"
                )
        level, depth = [child for element in level for child in element], depth + 1
        if depth > _DEEPEST:
            raise ValueError(f"{what}: its model is nested more than {_DEEPEST} deep")
    return ElementTree.tostring(root, encoding="unicode")
