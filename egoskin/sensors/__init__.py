"""Proximity skins: where sensors sit, what they measure, which signal they give.

Everything here works on TensorDicts with the keys named in `egoskin`, from this
project's environment, another simulator, a recording or a real robot.
"""

from egoskin.sensors.coverage import Field, Ray
from egoskin.sensors.field import FieldSensor
from egoskin.sensors.placement import place_area_uniform
from egoskin.sensors.signals import Binary, Localization, Proximity
from egoskin.sensors.skin import Skin

__all__ = [
    "Binary",
    "Field",
    "FieldSensor",
    "Localization",
    "Proximity",
    "Ray",
    "Skin",
    "place_area_uniform",
]
