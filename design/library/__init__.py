"""Real parts: libraries of gates, wirings, and designs as lists of DNA parts."""

from design.library.devices import Gate, Part, Reporter, SensorDevice
from design.library.library import Library
from design.library.wiring import PartsList, Sensor, Wiring

__all__ = ["Gate", "Library", "Part", "PartsList", "Reporter", "Sensor", "SensorDevice", "Wiring"]
