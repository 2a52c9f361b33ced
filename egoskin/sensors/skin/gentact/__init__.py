"""Import of GenTact's skin exports, and export to its CSV.

GenTact (https://github.com/HIRO-group/GenTact) is a Blender tool to design skins. All
dialects of its tables and its xacro macro, raw or expanded to URDF, are supported; the
format is detected from the content, not from the file name. Contract: nothing is
guessed silently. Ambiguous input is an error that names file and line; values filled in
and entries left out are listed in the provenance of the skin.
"""

from egoskin.sensors.skin.gentact.importing import load_gentact
from egoskin.sensors.skin.gentact.table import save_gentact

__all__ = ["load_gentact", "save_gentact"]
