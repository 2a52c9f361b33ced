"""Proximity skins: sensor placement, measurements and signals.

Everything here works on TensorDicts with the keys listed in `egoskin`, whether they
come from this project's environment, another simulator, a recording or a real robot.
"""

from egoskin.sensors.field import FieldSensor
from egoskin.sensors.history import History, KeepLast
from egoskin.sensors.imperfections.corruption import Corruption
from egoskin.sensors.pipeline import MASK_ALL, SensorPipeline
from egoskin.sensors.ray import RaySensor
from egoskin.sensors.signals import BeamMinimum, Binary, Localization, Proximity
from egoskin.sensors.skin.coverage import Field, Ray
from egoskin.sensors.skin.gentact import load_gentact, save_gentact
from egoskin.sensors.skin.placement import place_sensors
from egoskin.sensors.skin.skin import Skin
from egoskin.sensors.tactile import (
    ContactFree,
    ContactPenalty,
    ContactTermination,
    Tactile,
    contact_free,
    split_by_contact,
)

__all__ = [
    "MASK_ALL",
    "BeamMinimum",
    "Binary",
    "ContactFree",
    "ContactPenalty",
    "ContactTermination",
    "Corruption",
    "Field",
    "FieldSensor",
    "History",
    "KeepLast",
    "Localization",
    "Proximity",
    "Ray",
    "RaySensor",
    "SensorPipeline",
    "Skin",
    "Tactile",
    "contact_free",
    "load_gentact",
    "place_sensors",
    "save_gentact",
    "split_by_contact",
]
