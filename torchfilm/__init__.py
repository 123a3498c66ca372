"""torchfilm: synthetic microbial biofilms, many colonies at once, in PyTorch."""

from torchfilm.cells import Cells
from torchfilm.effect import Effect, LogNormal, Normal, Uniform
from torchfilm.effects.division import Division
from torchfilm.effects.growth import Growth
from torchfilm.effects.mechanics import Mechanics
from torchfilm.effects.removal import Removal
from torchfilm.physics.walls import Box, Channel, Plane, Sphere
from torchfilm.scene import Scene
from torchfilm.simulate import simulate
from torchfilm.state import Field, State
from torchfilm.tools.checks import InputError, SimulationError
from torchfilm.tools.timing import Timings

__version__ = "0.1.0"
__all__ = [
    "Box", "Cells", "Channel", "Division", "Effect", "Field", "Growth", "InputError", "LogNormal", "Mechanics", "Normal",
    "Plane", "Removal", "Scene", "SimulationError", "Sphere", "State", "Timings", "Uniform", "simulate",
]  # fmt: skip
