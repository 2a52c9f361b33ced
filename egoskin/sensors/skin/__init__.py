"""Skins: sensor poses and coverage, placement, import and export."""
