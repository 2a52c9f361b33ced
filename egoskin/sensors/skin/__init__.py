"""Where sensors sit: skins, placing them, importing and exporting them."""
