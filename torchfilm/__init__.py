"""torchfilm: synthetic microbial biofilms, many colonies at once, in PyTorch."""

from torchfilm import effect, measure, pictures, scenes
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
from torchfilm.explanation import explain
from torchfilm.initial_cells import Cells
from torchfilm.io.recorder import Recorder
from torchfilm.io.results import Results
from torchfilm.physics.walls import Box, Channel, Plane, Sphere
from torchfilm.pictures import show
from torchfilm.replay import GrowthRecording, Replay
from torchfilm.scene import Scene
from torchfilm.signals.boundary_conditions import (
    BoundaryConditions,
    Dirichlet,
    NoFlux,
    Open,
    Periodic,
)
from torchfilm.simulation import failures, rollout, simulate
from torchfilm.state import Field, State
from torchfilm.tools import checks
from torchfilm.tools.checks import InputError, SimulationError
from torchfilm.tools.hashing import digest
from torchfilm.tools.memory import keep_memory
from torchfilm.tools.timing import Timings
from torchfilm.tuning.settings import Settings, preset
from torchfilm.tuning.tuner import Tuned, tune
from torchfilm.version import __version__

__all__ = [
    "BoundaryConditions",
    "Box",
    "Cells",
    "Channel",
    "Circuit",
    "Dirichlet",
    "Division",
    "Effect",
    "Field",
    "Growth",
    "GrowthRecording",
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
