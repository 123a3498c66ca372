"""torchfilm: synthetic microbial biofilms, many colonies at once, in PyTorch."""

from torchfilm import effect, measure, pictures, scenes
from torchfilm.accuracy import Settings, preset
from torchfilm.cells import Cells
from torchfilm.circuits import kinetics, parts
from torchfilm.circuits.reactions import Reaction
from torchfilm.effect import Effect, LogNormal, Normal, Uniform
from torchfilm.effects.circuit import Circuit
from torchfilm.effects.division import Division
from torchfilm.effects.growth import Growth
from torchfilm.effects.mechanics import Mechanics
from torchfilm.effects.medium import Medium, Signal
from torchfilm.effects.nutrition import Monod
from torchfilm.effects.removal import Removal
from torchfilm.effects.rules import Rules
from torchfilm.explain import explain
from torchfilm.physics.walls import Box, Channel, Plane, Sphere
from torchfilm.pictures import show
from torchfilm.recorder import Recorder
from torchfilm.replay import Course, Replay
from torchfilm.results import Results
from torchfilm.scene import Scene
from torchfilm.signals.faces import Faces, Fixed, NoFlux, Open, Periodic
from torchfilm.simulate import failures, rollout, simulate
from torchfilm.state import Field, State
from torchfilm.tools import checks
from torchfilm.tools.checks import InputError, SimulationError
from torchfilm.tools.memory import keep_memory
from torchfilm.tools.timing import Timings
from torchfilm.tools.told import digest
from torchfilm.tune import Tuned, tune
from torchfilm.version import __version__

__all__ = [
    "Box",
    "Cells",
    "Channel",
    "Circuit",
    "Course",
    "Division",
    "Effect",
    "Faces",
    "Field",
    "Fixed",
    "Growth",
    "InputError",
    "LogNormal",
    "Mechanics",
    "Medium",
    "Monod",
    "NoFlux",
    "Normal",
    "Open",
    "Periodic",
    "Plane",
    "Reaction",
    "Recorder",
    "Removal",
    "Replay",
    "Results",
    "Rules",
    "Scene",
    "Settings",
    "Signal",
    "SimulationError",
    "Sphere",
    "State",
    "Timings",
    "Tuned",
    "Uniform",
    "__version__",
    "checks",
    "digest",
    "effect",
    "explain",
    "failures",
    "keep_memory",
    "kinetics",
    "measure",
    "parts",
    "pictures",
    "preset",
    "rollout",
    "scenes",
    "show",
    "simulate",
    "tune",
]
