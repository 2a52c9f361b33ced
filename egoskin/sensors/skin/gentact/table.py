"""GenTact's tables: the CSV of all versions and the 3-D print export."""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from egoskin.sensors.skin.gentact.source import (
    NO_RADIUS,
    Export,
    Links,
    Problems,
    Sensor,
    SensorError,
    number,
    read_radius,
)
from egoskin.sensors.skin.skin import Skin
from egoskin.storage.files import write_file

_HEADER = "Index,X,Y,Z,NormX,NormY,NormZ,Radius,Parent,Object Name in Blender"
_HEADERS = (
    _HEADER,
    "Index,X,Y,Z,NormX,NormY,NormZ,Radius,Parent",
    "Index,X,Y,Z,Radius,Parent",
    "SensorNum,RelX,RelY,RelZ,Radius,path",
    "Sensor Name,X Offset,Y Offset,Z Offset,Radius,Parent Path",
    "Index,X,Y,Z,Stem X,Stem Y,Stem Z,Radius,Parent",
)
_PLACE = ("x", "y", "z")
_NORMAL = tuple(f"norm{axis}" for axis in _PLACE)
_STEM = tuple(f"stem{axis}" for axis in _PLACE)
# Accepted column headers, without spaces and punctuation, compared ignoring case. The
# identifier of a sensor is a number ("index") or any text ("name").
_COLUMNS = {
    "index": "index sensor num number id sensornum sensornumber sensorindex sensorid",
    "name": "name sensorname",
    **{a: f"{a} rel{a} {a}offset offset{a} pos{a} position{a} {a}pos" for a in _PLACE},
    **{f"norm{a}": f"norm{a} {a}norm normal{a} {a}normal n{a}" for a in _PLACE},
    **{f"stem{a}": f"stem{a} {a}stem" for a in _PLACE},
    "radius": "radius radii sensorradius",
    "parent": "parent parents path parentpath parentlink link linkname",
    "object": "object objectname objectnameinblender",
}
_COLUMN_OF = {word: name for name, words in _COLUMNS.items() for word in words.split()}
_UNITS = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1.0),
    **dict.fromkeys(("cm", "centimetres", "centimeters"), 1e-2),
    **dict.fromkeys(("mm", "millimetres", "millimeters"), 1e-3),
}
_HEADING = re.compile(r"(?P<name>[^()\[\]]*)([(\[](?P<unit>[^()\[\]]*)[)\]])?")
_DECIMAL_COMMA = re.compile(r"^([-+]?\d*),(\d+(?:[eE][-+]?\d+)?)$")


def save_gentact(skin: Skin, path: Path | str) -> tuple[str, ...]:
    """Write the skin as GenTact's current CSV; return the fields that are lost.

    Args:
        skin: The skin. An unknown radius is written as GenTact's 0.1 m.
        path: File to write.

    Returns:
        Which of the fields ``coverage``, ``range`` and ``roll_deg`` the skin uses but
        the format cannot store.

    Raises:
        ValueError: If the name of a link or of the robot contains a slash, the
            separator of GenTact's paths.
    """
    slashed = [name for name in (*skin.links, skin.robot) if "/" in name]
    if slashed:
        raise ValueError(
            f"{slashed[0]!r} contains '/', the separator of GenTact's paths"
        )
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(_HEADER.split(","))
    radius = np.where(np.isnan(skin.radius), NO_RADIUS, skin.radius)
    for i, link in enumerate(skin.links):
        numbers = (*skin.position[i], *skin.normal[i], radius[i])
        # repr is the shortest text that parses to the same number.
        row = [repr(float(v)) for v in numbers]
        writer.writerow([i, *row, f"/{skin.robot}/{link}/visuals", "visuals"])
    write_file(Path(path), text.getvalue().encode())
    lost = {
        "coverage": any(c is not None for c in skin.coverage),
        "range": bool((~np.isnan(skin.range)).any()),
        "roll_deg": bool(skin.roll_deg.any()),
    }
    return tuple(name for name, is_lost in lost.items() if is_lost)


def _rows(text: str, path: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield the rows that are not blank or comments (#), as (where, stripped cells).

    Spreadsheets may write semicolons or tabs as delimiters; decimal commas are then
    accepted.
    """
    lines = (line for line in text.splitlines() if line.strip())
    header = next((line for line in lines if not line.lstrip().startswith("#")), "")
    delimiter = max(",;\t", key=header.count)
    reader = csv.reader(
        io.StringIO(text, newline=""), delimiter=delimiter, skipinitialspace=True
    )
    while True:
        where = f"{path}:{reader.line_num + 1}"
        try:
            row = next(reader, None)
        except csv.Error as error:
            raise ValueError(f"{where}: {error}") from None
        if row is None:
            return
        # An unclosed quote would swallow the following rows.
        if any("\n" in cell or "\r" in cell for cell in row):
            raise ValueError(f"{where}: a quoted value must end on its line")
        cells = [cell.strip() for cell in row]
        if delimiter != ",":
            cells = [_DECIMAL_COMMA.sub(r"\1.\2", cell) for cell in cells]
        if any(cells) and not cells[0].startswith("#"):
            yield where, cells


def read_table(text: str, path: Path, names: Links, problems: Problems) -> Export:
    """Return the sensors of a table of any dialect."""
    rows = list(_rows(text, path))
    if not rows:
        raise ValueError(f"{path}: the file is empty")
    where, header = rows.pop(0)
    while header and not header[-1]:
        header.pop()
    columns, units = _read_header(header, where)
    # Besides sensors, the 3-D print export contains clips and object names (headings).
    kinds = Counter(_kind(cells) for _, cells in rows)
    plain = ["index", *_PLACE, "radius", "parent"]
    is_print = columns[0] == "index" and (
        _STEM[0] in columns or (columns == plain and bool(kinds.keys() - {"sensors"}))
    )
    if is_print:
        rows = [(w, cells) for w, cells in rows if _kind(cells) == "sensors"]
    if not rows:
        raise ValueError(f"{path}: no sensors found")
    # Without the parent column, all sensors are on one link.
    link = None if "parent" in columns else names.default(where)
    sensors = []
    for where, cells in rows:
        with problems.collect():
            record = _record(cells, columns, where, is_print)
            sensors.append(_read_sensor(record, names, link, where))
    # The unit of print exports without stem columns (old versions) is unknown.
    unit = 1.0 if not is_print else 1e-3 if _STEM[0] in columns else None
    given = units.get("x")
    radius_unit = units.get("radius")
    # Print exports with stems or headings have radii in metres.
    if radius_unit is None and is_print and (unit is not None or kinds["headings"]):
        radius_unit = 1.0
    return Export(
        dialect=",".join(header),
        sensors=sensors,
        unit=unit if given is None else given,
        unit_is_given=given is not None,
        radius_unit=radius_unit,
        skipped={k: n for k, n in kinds.items() if k != "sensors"} if is_print else {},
    )


def _read_header(
    header: Sequence[str], where: str
) -> tuple[list[str], dict[str, float]]:
    """Return the names of the columns, and their units given in brackets [m].

    Raises:
        ValueError: If a column is unknown, duplicate or missing, or a unit is invalid.
    """
    columns, units = [], {}
    for cell in header:
        heading = _HEADING.fullmatch(cell)
        word = re.sub(r"[\s_.-]+", "", heading["name"] if heading else cell).casefold()
        column = _COLUMN_OF.get(word)
        if heading is None or column is None:
            raise ValueError(
                f"{where}: unknown header {','.join(header)!r}; GenTact writes "
                + "; ".join(map(repr, _HEADERS))
                + f"; rename or remove the column {cell!r}"
            )
        if column in columns:
            raise ValueError(
                f"{where}: {header[columns.index(column)]!r} and {cell!r} are both the "
                f"sensor's {column}; remove one"
            )
        if heading["unit"] is not None and column in (*_PLACE, *_STEM, "radius"):
            unit = _UNITS.get(heading["unit"].strip().casefold())
            if unit is None:
                raise ValueError(
                    f"{where}: the unit of {cell!r} must be one of m, cm, mm"
                )
            units[column] = unit
        columns.append(column)
    if not {"parent", "radius", *_NORMAL} & set(columns):
        raise ValueError(
            f"{where}: these are vertices of a mesh, not sensors; export the sensors"
        )
    wanted = [_PLACE, *(v for v in (_NORMAL, _STEM) if set(v) & set(columns))]
    for vector in wanted:
        missing = [name for name in vector if name not in columns]
        if missing:
            raise ValueError(f"{where}: there is no column {', '.join(missing)}")
    if len({units.get(axis) for axis in _PLACE}) > 1:
        raise ValueError(f"{where}: x, y and z must have the same unit")
    return columns, units


def _read_sensor(
    record: Mapping[str, str], names: Links, link: str | None, where: str
) -> Sensor:
    """Return the sensor of a row; ``link`` is None if each row names its own."""
    if "index" in record:
        number(record["index"], where, "index")
    if link is None and record["parent"]:
        link = names.of_path(record["parent"], where)
    return Sensor(
        where=where,
        name=record.get("index", record.get("name", where)),
        link=link or names.default(where),
        position=_vector(record, _PLACE, where),
        normal=_vector(record, _NORMAL, where) if _NORMAL[0] in record else None,
        radius=read_radius(record.get("radius", ""), where),
    )


def _kind(cells: Sequence[str]) -> str:
    """Return the kind of a row: sensor or, in the print export, clip or heading."""
    if cells[0] == "CLIP":
        return "clips"
    # A heading is an object's name alone in its row.
    return "sensors" if any(cells[1:]) or cells[0].isdigit() else "headings"


def _record(
    cells: list[str], columns: Sequence[str], where: str, is_print: bool
) -> dict[str, str]:
    """Return a row by column name; the print export may omit trailing cells."""
    while len(cells) > len(columns) and not cells[-1]:
        cells = cells[:-1]
    if is_print:
        cells = cells + [""] * (len(columns) - len(cells))
    if len(cells) != len(columns):
        raise SensorError(
            f"{where}: expected {len(columns)} values ({', '.join(columns)}), got "
            f"{len(cells)}"
        )
    return dict(zip(columns, cells, strict=True))


def _vector(
    record: Mapping[str, str], columns: Sequence[str], where: str
) -> np.ndarray:
    """Return three numbers of a row."""
    return np.array([number(record[c], where, c) for c in columns])
