"""Check of a robot's model that is given as text, possibly from an untrusted source.

Contract: MuJoCo receives only text that was parsed, checked element by element and
serialised again. So a model refers to no other file, and nothing in it is executed.
"""

from __future__ import annotations

from xml.etree import ElementTree

# The elements of a robot of primitives. None of them refers to a file or a plugin.
_ELEMENTS = frozenset(
    (
        *("mujoco", "compiler", "option", "flag", "default", "asset", "material"),
        *(
            "worldbody",
            "body",
            "frame",
            "inertial",
            "joint",
            "freejoint",
            "geom",
            "site",
        ),
        *("contact", "exclude", "pair"),
    )
)
_LONGEST, _DEEPEST = 2**20, 200


def checked_model(text: str, what: str) -> str:
    """Return an MJCF from any source as text that MuJoCo can safely read.

    Args:
        text: The MJCF.
        what: What the model belongs to, for the error text.

    Raises:
        ValueError: If it is not an MJCF, or contains more than a robot of primitives.
    """
    if len(text) > _LONGEST:
        raise ValueError(f"{what}: its model is longer than {_LONGEST:,} characters")
    # Entities could refer to files, or expand without bounds.
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError(f"{what}: DOCTYPE and ENTITY are not allowed in its model")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"{what}: its model is not valid XML: {error}") from error
    if root.tag != "mujoco":
        raise ValueError(
            f"{what}: the root element of its model must be <mujoco>, got <{root.tag}>"
        )
    level, depth = [root], 0
    while level:
        for element in level:
            if element.tag not in _ELEMENTS:
                raise ValueError(
                    f"{what}: its model contains <{element.tag}>; a robot stored as "
                    "data may have only bodies, joints and primitives, and no files"
                )
        level, depth = [child for element in level for child in element], depth + 1
        if depth > _DEEPEST:
            raise ValueError(f"{what}: its model is nested more than {_DEEPEST} levels")
    return ElementTree.tostring(root, encoding="unicode")
