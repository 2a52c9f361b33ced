"""Skins designed in GenTact: import of its exports, and export to its CSV.

GenTact (https://github.com/HIRO-group/GenTact) designs skins in Blender. Every dialect
of its tables is read, and its xacro macro, raw or expanded to URDF; which one a file is
shows in its content, whatever its name. Contract: nothing is guessed in silence. What
cannot be read for certain is an error that names file and line; what was filled in or
left out stands in the provenance of the skin.
"""

from egoskin.sensors.skin.gentact.importing import load_gentact
from egoskin.sensors.skin.gentact.table import save_gentact

__all__ = ["load_gentact", "save_gentact"]
