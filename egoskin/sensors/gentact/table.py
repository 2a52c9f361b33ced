"""GenTact's tables: the CSV of every version and the 3-D print export."""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from egoskin.sensors.gentact.source import (
    NO_RADIUS,
    Export,
    Links,
    Sensor,
    number,
    read_radius,
)
from egoskin.sensors.skin import Skin

_HEADER = "Index,X,Y,Z,NormX,NormY,NormZ,Radius,Parent,Object Name in Blender"
_PRINT_HEADER = "Index,X,Y,Z,Stem X,Stem Y,Stem Z,Radius,Parent"
_PLAIN_HEADER = "Index,X,Y,Z,Radius,Parent"
_HEADERS = (
    _HEADER,
    "Index,X,Y,Z,NormX,NormY,NormZ,Radius,Parent",
    _PLAIN_HEADER,
    "SensorNum,RelX,RelY,RelZ,Radius,path",
    _PRINT_HEADER,
)
_MESH_HEADER = "Index,X,Y,Z,Object Name"
_DECIMAL_COMMA = re.compile(r"^([-+]?\d*),(\d+(?:[eE][-+]?\d+)?)$")
# Columns of the oldest dialect by today's names.
_RENAMED = {
    "sensornum": "index",
    "relx": "x",
    "rely": "y",
    "relz": "z",
    "path": "parent",
}


def save_gentact(skin: Skin, path: Path | str) -> tuple[str, ...]:
    """Write the skin as GenTact's current CSV; return what that cannot hold.

    Args:
        skin: The skin. An unknown radius is written as GenTact's 0.1 m.
        path: File to write.

    Returns:
        Names of the fields of the skin that are lost, of ``coverage``, ``range`` and
        ``roll_deg``.

    Raises:
        ValueError: If a link's name holds a slash, which divides GenTact's paths.
    """
    slashed = [name for name in (*skin.links, skin.robot) if "/" in name]
    if slashed:
        raise ValueError(f"{slashed[0]!r} holds '/', which divides GenTact's paths")
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(_HEADER.split(","))
        radius = np.where(np.isnan(skin.radius), NO_RADIUS, skin.radius)
        for i, link in enumerate(skin.links):
            numbers = (*skin.position[i], *skin.normal[i], radius[i])
            # repr, the shortest text that reads as the same number
            row = [repr(float(v)) for v in numbers]
            writer.writerow([i, *row, f"/{skin.robot}/{link}/visuals", "visuals"])
    lost = {
        "coverage": any(c is not None for c in skin.coverage),
        "range": bool((~np.isnan(skin.range)).any()),
        "roll_deg": bool(skin.roll_deg.any()),
    }
    return tuple(name for name, is_lost in lost.items() if is_lost)


def _rows(text: str, path: Path) -> Iterator[tuple[str, list[str]]]:
    """Rows that are neither blank nor comments (#), as (where, stripped cells).

    A spreadsheet may have put semicolons or tabs between the cells, and then decimal
    commas into them.
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
        # A quote that is never closed would swallow the rows that follow.
        if any("\n" in cell or "\r" in cell for cell in row):
            raise ValueError(f"{where}: a quoted value must end on its line")
        cells = [cell.strip() for cell in row]
        if delimiter != ",":
            cells = [_DECIMAL_COMMA.sub(r"\1.\2", cell) for cell in cells]
        if any(cells) and not cells[0].startswith("#"):
            yield where, cells


def read_table(text: str, path: Path, names: Links) -> Export:
    """Sensors of a table of any dialect."""
    rows = list(_rows(text, path))
    if not rows:
        raise ValueError(f"{path}: the file is empty")
    where, header = rows.pop(0)
    written = ",".join(header).rstrip(",")
    if written.casefold() == _MESH_HEADER.casefold():
        raise ValueError(
            f"{where}: these are vertices of a mesh, not sensors; export the sensors"
        )
    dialect = {h.casefold(): h for h in _HEADERS}.get(written.casefold())
    if dialect is None:
        raise ValueError(
            f"{where}: unknown header {written!r}; GenTact's are "
            + "; ".join(map(repr, _HEADERS))
        )
    columns = [_RENAMED.get(c, c) for c in dialect.casefold().split(",")]
    # The 3-D print export has, besides sensors, clips and the names of objects.
    kinds = Counter(_kind(cells) for _, cells in rows)
    is_print = dialect == _PRINT_HEADER or (
        dialect == _PLAIN_HEADER and bool(kinds.keys() - {"sensors"})
    )
    if is_print:
        rows = [(w, cells) for w, cells in rows if _kind(cells) == "sensors"]
    if not rows:
        raise ValueError(f"{path}: there is no sensor in it")
    records = [_record(cells, columns, w, is_print) for w, cells in rows]
    others = {"/" + record["parent"].strip("/") for record in records}
    sensors = []
    for (where, _), record in zip(rows, records, strict=True):
        number(record["index"], where, columns[0])
        parent = record["parent"]
        sensors.append(
            Sensor(
                where=where,
                name=record["index"],
                link=names.of_path(parent, others, where)
                if parent
                else names.default(where, ""),
                position=_vector(record, ("x", "y", "z"), where),
                normal=_vector(record, ("normx", "normy", "normz"), where)
                if "normx" in columns
                else None,
                radius=read_radius(record["radius"], where),
            )
        )
    return Export(
        dialect=dialect,
        sensors=sensors,
        # Before it had stems the print export came in one unit or another.
        unit=1.0 if not is_print else 1e-3 if dialect == _PRINT_HEADER else None,
        scales_radius=not is_print,
        skipped={k: n for k, n in kinds.items() if k != "sensors"},
    )


def _kind(cells: Sequence[str]) -> str:
    """What a row describes: a sensor, or in the print export a clip or an object."""
    if cells[0] == "CLIP":
        return "clips"
    # An object's name stands alone.
    return "sensors" if any(cells[1:]) or cells[0].isdigit() else "headings"


def _record(
    cells: list[str], columns: Sequence[str], where: str, is_print: bool
) -> dict[str, str]:
    """A row by its columns; the print export leaves cells at the end out."""
    while len(cells) > len(columns) and not cells[-1]:
        cells = cells[:-1]
    if is_print:
        cells = cells + [""] * (len(columns) - len(cells))
    if len(cells) != len(columns):
        raise ValueError(
            f"{where}: expected {len(columns)} values ({', '.join(columns)}), got "
            f"{len(cells)}"
        )
    return dict(zip(columns, cells, strict=True))


def _vector(
    record: Mapping[str, str], columns: Sequence[str], where: str
) -> np.ndarray:
    """Three numbers of a row."""
    return np.array([number(record[c], where, c) for c in columns])
