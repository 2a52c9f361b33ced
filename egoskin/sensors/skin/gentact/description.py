"""Reading of GenTact's robot descriptions: the xacro macro, raw or expanded to URDF."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from egoskin.sensors.skin.gentact.source import (
    Export,
    Links,
    Problems,
    Sensor,
    SensorError,
    number,
    read_radius,
)

# Tolerance between a normal and the z axis of its frame [deg]: files rounded by hand.
_SAME_DIRECTION = 2.0
_SENSOR_TAGS = ("xacro:self_cap_sensor", "xacro:tof_sensor")
# Some versions of the exporter omit the > between a sensor's attributes and <origin>.
_UNCLOSED_SENSOR = re.compile(r'(<xacro:\w+_sensor\s[^<>]*")(?=\s*<origin\s)')
_SENSOR_JOINT = re.compile(r"(^|[_/])sensor_\d+_joint$")
# GenTact's magnetic sensors are not proximity sensors.
_MAGNETIC = "mag_sensor"

Frame = tuple[np.ndarray, np.ndarray]
"""Rotation ``[3, 3]`` and translation ``[3]``."""


class Xml:
    """A parsed file with the line number of each element; DOCTYPE is an error."""

    def __init__(self, text: str, path: Path) -> None:
        self.path = path
        self._lines: dict[ElementTree.Element, int] = {}
        body = _UNCLOSED_SENSOR.sub(r"\1>", text.lstrip())
        # GenTact writes a newline before the XML declaration, which is not valid XML.
        above = text[: len(text) - len(text.lstrip())].count("\n")
        builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate()

        def start(tag: str, attributes: dict[str, str]) -> None:
            element = builder.start(tag, attributes)
            self._lines[element] = parser.CurrentLineNumber + above

        def refuse(*_: object) -> None:
            raise ValueError(
                f"{path}:{parser.CurrentLineNumber + above}: a DOCTYPE is not "
                "allowed; remove it"
            )

        parser.StartElementHandler = start
        parser.EndElementHandler = builder.end
        parser.StartDoctypeDeclHandler = refuse
        try:
            parser.Parse(body, True)
        except expat.ExpatError as error:
            text = expat.errors.messages[error.code]
            raise ValueError(f"{path}:{error.lineno + above}: {text}") from None
        self.root = builder.close()
        self.properties = {
            p.get("name", ""): p.get("value", "")
            for p in self.root.iter("xacro:property")
        }

    def where(self, element: ElementTree.Element) -> str:
        """File and line of an element."""
        return f"{self.path}:{self._lines[element]}"

    def value(self, element: ElementTree.Element, name: str, default: str = "") -> str:
        """An attribute, with the xacro properties of the file substituted."""
        text = element.get(name, default).strip()
        return re.sub(r"\$\{(\w+)\}", lambda m: self.properties.get(m[1], m[0]), text)

    def vector(self, element: ElementTree.Element, name: str) -> np.ndarray:
        """An attribute of three numbers; zero if it is missing."""
        parts = self.value(element, name, "0 0 0").split()
        if len(parts) != 3:
            raise SensorError(
                f"{self.where(element)}: {name} must be three numbers, got "
                f"{' '.join(parts)!r}"
            )
        return np.array([number(p, self.where(element), name) for p in parts])

    def frame(self, element: ElementTree.Element) -> Frame:
        """Rotation and translation of an element's origin; identity without one."""
        origin = element.find("origin")
        if origin is None:
            return np.eye(3), np.zeros(3)
        # R = Rz(yaw) Ry(pitch) Rx(roll)
        rpy = self.vector(origin, "rpy")
        (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
        x_turn = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
        y_turn = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        z_turn = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        return z_turn @ y_turn @ x_turn, self.vector(origin, "xyz")


def read_description(xml: Xml, names: Links, problems: Problems) -> Export:
    """Return the sensors of a xacro macro or of a URDF."""
    tags = Counter(element.tag for element in xml.root.iter())
    if any(tags[tag] for tag in _SENSOR_TAGS):
        sensors, dialect = _read_xacro(xml, names, problems), "xacro"
        num_magnetic = tags[f"xacro:{_MAGNETIC}"]
    else:
        joints = [j for j in xml.root.findall("joint") if _is_sensor(j)]
        kept = [j for j in joints if _MAGNETIC not in j.get("name", "")]
        if not kept:
            raise ValueError(
                f"{xml.path}: no GenTact sensors found: neither <{_SENSOR_TAGS[0]}> "
                "nor fixed joints named <namespace>_sensor_<number>_joint or "
                "<namespace>/sensor_<number>_joint"
            )
        sensors, dialect = _read_urdf(xml, names, kept, problems), "urdf"
        num_magnetic = len(joints) - len(kept)
    skipped = {_MAGNETIC: num_magnetic} if num_magnetic else {}
    return Export(dialect=dialect, sensors=sensors, skipped=skipped)


def _is_sensor(joint: ElementTree.Element) -> bool:
    """Whether a joint of a URDF carries a GenTact sensor."""
    name = joint.get("name", "")
    return joint.get("type") == "fixed" and bool(_SENSOR_JOINT.search(name))


def _read_xacro(xml: Xml, names: Links, problems: Problems) -> list[Sensor]:
    """Return the sensors of a xacro file with one sensor macro, or without macros."""
    macros = [
        macro
        for macro in xml.root.iter("xacro:macro")
        if any(e.tag in _SENSOR_TAGS for e in macro.iter())
    ]
    if len(macros) > 1:
        raise ValueError(
            f"{xml.where(macros[1])}: expected one macro with sensors, got "
            f"{len(macros)}; put each into its own file"
        )
    macro = macros[0] if macros else xml.root
    base, name = np.eye(3), "${parent}"
    offset = np.zeros(3)
    for dermis in macro.iter("xacro:dermis_base_macro"):
        (base, offset), name = xml.frame(dermis), dermis.get("parent", name)
    link = (
        names.default(xml.where(macro), macro.get("name", ""))
        if "${" in name
        else names.of_path(name, xml.where(macro))
    )
    sensors = []
    for element in (e for e in macro.iter() if e.tag in _SENSOR_TAGS):
        with problems.collect():
            sensors.append(_read_tag(xml, element, link, (base, offset)))
    return sensors


def _read_tag(xml: Xml, element: ElementTree.Element, link: str, base: Frame) -> Sensor:
    """Return the sensor of a xacro element, given its link and the skin's frame."""
    where = xml.where(element)
    if element.get("sensor_number") is None or element.find("origin") is None:
        raise SensorError(f"{where}: a sensor needs a sensor_number and an <origin>")
    normal = None
    axes = [f"normal_{axis}" for axis in "xyz"]
    if any(axis in element.attrib for axis in axes):
        normal = np.array([number(xml.value(element, a), where, a) for a in axes])
    return _framed(
        xml,
        element,
        normal,
        base,
        link=link,
        name=f"{element.tag} {element.get('sensor_number')}",
        radius=read_radius(xml.value(element, "sensor_radius"), where),
    )


def _read_urdf(
    xml: Xml, names: Links, joints: Sequence[ElementTree.Element], problems: Problems
) -> list[Sensor]:
    """Return the sensors of a URDF, given the fixed joints that carry them."""
    tree = _Tree(xml, names)
    spheres = {
        link.get("name"): link.find("visual/geometry/sphere")
        for link in xml.root.findall("link")
    }
    sensors = []
    for joint in joints:
        with problems.collect():
            link, base = tree.climb(joint)
            axis = joint.find("axis")
            sphere = spheres.get(_end(xml, joint, "child"))
            radius = "" if sphere is None else xml.value(sphere, "radius")
            sensor = _framed(
                xml,
                joint,
                # Fixed joints need no axis; GenTact stores the normal in it.
                None if axis is None else xml.vector(axis, "xyz"),
                base,
                link=link,
                name=joint.get("name", ""),
                radius=read_radius(radius, xml.where(joint)),
            )
            sensors.append(sensor)
    return sensors


class _Tree:
    """Lookup of the robot's link that a URDF's links are fixed to, and their frames."""

    def __init__(self, xml: Xml, names: Links) -> None:
        self._xml, self._names = xml, names
        self._above: dict[str, ElementTree.Element] = {}
        for joint in xml.root.findall("joint"):
            child = _end(xml, joint, "child")
            if child in self._above:
                raise ValueError(
                    f"{xml.where(joint)}: the link {child!r} is already the child "
                    f"of a joint ({xml.where(self._above[child])}); remove one"
                )
            self._above[child] = joint
        # Results so far: link of the robot and frame in it; or, if there is none, the
        # name of the link at which the search ended.
        self._frames: dict[str, tuple[str, Frame] | str] = {}

    def climb(self, joint: ElementTree.Element) -> tuple[str, Frame]:
        """Return the robot's link above a joint, and the joint parent's frame in it.

        Raises:
            SensorError: If the parent is not a link of the robot and not fixed to one.
        """
        name = _end(self._xml, joint, "parent")
        way: dict[str, ElementTree.Element] = {}
        while (found := self._frame(name)) is None:
            up = self._above.get(name)
            # A link passed twice is a cycle.
            if up is None or up.get("type") != "fixed" or name in way:
                found = name
                break
            way[name] = up
            name = _end(self._xml, up, "parent")
        for under, up in reversed(way.items()):
            if not isinstance(found, str):
                link, (rotation, position) = found
                turn, shift = self._xml.frame(up)
                found = (link, (rotation @ turn, position + rotation @ shift))
            self._frames[under] = found
        if isinstance(found, str):
            raise SensorError(
                f"{self._xml.where(joint)}: the sensor is attached to {found!r}, which "
                "is neither a link of the robot nor fixed to one; map it with link_map "
                "(--link-map)",
                self._names.known(),
            )
        return found

    def _frame(self, name: str) -> tuple[str, Frame] | str | None:
        """Known result for a link, without looking at its parents; None if unknown."""
        if name not in self._frames and (link := self._names.match(name)) is not None:
            self._names.found[name] = link
            self._frames[name] = (link, (np.eye(3), np.zeros(3)))
        return self._frames.get(name)


def _end(xml: Xml, joint: ElementTree.Element, which: str) -> str:
    """Name of a joint's parent or child link."""
    end = joint.find(which)
    if end is None or not end.get("link"):
        raise SensorError(f"{xml.where(joint)}: the joint has no <{which} link=...>")
    return end.get("link", "")


def _framed(
    xml: Xml,
    element: ElementTree.Element,
    normal: np.ndarray | None,
    base: Frame,
    *,
    link: str,
    name: str,
    radius: float,
) -> Sensor:
    """Return the sensor of an element with an origin and an optional normal.

    Both are relative to a base frame, which is given in the frame of the link. The
    normal must be the z axis of the origin's frame. If it is not, an origin without rpy
    gives no frame, only a position; one with rpy is an error. Exporters write (0, 0, 0)
    for a missing normal.

    Raises:
        SensorError: If the normal and the z axis of rpy differ.
    """
    own, position = xml.frame(element)
    where = xml.where(element)
    x_axis: np.ndarray | None = own[:, 0]
    if normal is None or not normal.any():
        normal = own[:, 2]
    cosine = own[:, 2] @ normal / max(math.hypot(*normal), 1e-9)
    angle = math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))
    if angle > _SAME_DIRECTION:
        if (own != np.eye(3)).any():
            raise SensorError(
                f"{where}: the normal {normal.tolist()} and the z axis of rpy, "
                f"{own[:, 2].round(4).tolist()}, must have the same direction, got "
                f"{angle:.1f} deg between them; remove the wrong one (for rpy: set "
                "0 0 0)"
            )
        x_axis = None
    rotation, offset = base
    return Sensor(
        where=where,
        name=name,
        link=link,
        position=rotation @ position + offset,
        normal=rotation @ normal,
        x_axis=None if x_axis is None else rotation @ x_axis,
        radius=radius,
    )
