"""torchfilm: synthetic microbial biofilms, many colonies at once, in PyTorch."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from torchfilm import effect
from torchfilm.circuits import kinetics, parts
from torchfilm.circuits.reactions import Reaction
from torchfilm.distributions import LogNormal, Normal, Uniform
from torchfilm.effect import Effect
from torchfilm.effects.circuit import Circuit
from torchfilm.effects.division import Division
from torchfilm.effects.erosion import Erosion
from torchfilm.effects.growth import Growth
from torchfilm.effects.lysis import Lysis
from torchfilm.effects.mechanics import Mechanics
from torchfilm.effects.medium import Medium
from torchfilm.effects.medium_reactions import MediumReactions
from torchfilm.effects.motility import Motility
from torchfilm.effects.nutrition import Monod
from torchfilm.effects.removal import Removal
from torchfilm.effects.rules import Rules
from torchfilm.effects.scaled import Scaled
from torchfilm.effects.signal import Signal
from torchfilm.effects.sloughing import Sloughing
from torchfilm.founders import Founders
from torchfilm.image_field import ImageField
from torchfilm.initial_cells import Cells
from torchfilm.inocula import inoculum
from torchfilm.loop import advance, failures
from torchfilm.model import Model
from torchfilm.physics.adhesion import Adhesion
from torchfilm.physics.walls import Box, Channel, Plane, Sphere
from torchfilm.replay import GrowthRecording, Replay
from torchfilm.resolver import Values
from torchfilm.rule_views import CellsView, DivisionView
from torchfilm.scene import Scene
from torchfilm.signals.boundary_conditions import (
    BoundaryConditions,
    Dirichlet,
    Flux,
    NoFlux,
    Open,
    Periodic,
    Robin,
)
from torchfilm.signals.schedule import Schedule
from torchfilm.simulation import rollout, simulate
from torchfilm.state import Field, State
from torchfilm.tools import checks, displays, progress, tables, tangents
from torchfilm.tools.checks import InputError, SimulationError
from torchfilm.tools.hashing import digest
from torchfilm.tools.memory import keep_memory
from torchfilm.tools.ragged import Groups
from torchfilm.tools.threads import one_torch_thread
from torchfilm.tools.timing import Timings
from torchfilm.values import PerColony, Value, physical
from torchfilm.version import __version__

if TYPE_CHECKING:
    from torchfilm import measure, pictures, scenes
    from torchfilm.cellmodeller import from_cellmodeller
    from torchfilm.explanation import explain
    from torchfilm.io.lineage import Lineage
    from torchfilm.io.recorder import Recorder
    from torchfilm.io.results import Results
    from torchfilm.io.table import cell_table
    from torchfilm.pictures import LivePlot, show
    from torchfilm.tuning.settings import Settings, preset
    from torchfilm.tuning.tuned import Tuned
    from torchfilm.tuning.tuner import tune

# Imported when first used: `import torchfilm` takes little longer than torch.
_LAZY_MODULES = ("measure", "pictures", "scenes")
_LAZY = {
    "LivePlot": "torchfilm.pictures",
    "Lineage": "torchfilm.io.lineage",
    "Recorder": "torchfilm.io.recorder",
    "Results": "torchfilm.io.results",
    "cell_table": "torchfilm.io.table",
    "explain": "torchfilm.explanation",
    "from_cellmodeller": "torchfilm.cellmodeller",
    "show": "torchfilm.pictures",
    "Settings": "torchfilm.tuning.settings",
    "preset": "torchfilm.tuning.settings",
    "Tuned": "torchfilm.tuning.tuned",
    "tune": "torchfilm.tuning.tuner",
}

__all__ = [
    "Adhesion",
    "BoundaryConditions",
    "Box",
    "Cells",
    "CellsView",
    "Channel",
    "Circuit",
    "Dirichlet",
    "Division",
    "DivisionView",
    "Effect",
    "Erosion",
    "Field",
    "Flux",
    "Founders",
    "Groups",
    "Growth",
    "GrowthRecording",
    "ImageField",
    "InputError",
    "Lineage",
    "LivePlot",
    "LogNormal",
    "Lysis",
    "Mechanics",
    "Medium",
    "MediumReactions",
    "Model",
    "Monod",
    "Motility",
    "NoFlux",
    "Normal",
    "Open",
    "PerColony",
    "Periodic",
    "Plane",
    "Reaction",
    "Recorder",
    "Removal",
    "Replay",
    "Results",
    "Robin",
    "Rules",
    "Scaled",
    "Scene",
    "Schedule",
    "Settings",
    "Signal",
    "SimulationError",
    "Sloughing",
    "Sphere",
    "State",
    "Timings",
    "Tuned",
    "Uniform",
    "Value",
    "Values",
    "__version__",
    "advance",
    "cell_table",
    "checks",
    "digest",
    "displays",
    "effect",
    "explain",
    "failures",
    "from_cellmodeller",
    "inoculum",
    "keep_memory",
    "kinetics",
    "measure",
    "one_torch_thread",
    "parts",
    "physical",
    "pictures",
    "preset",
    "progress",
    "rollout",
    "scenes",
    "show",
    "simulate",
    "tables",
    "tangents",
    "tune",
]


if not TYPE_CHECKING:  # type checkers know the names above, and no others

    def __getattr__(name: str) -> Any:
        if name in _LAZY_MODULES:
            return import_module(f"torchfilm.{name}")
        if name in _LAZY:
            return getattr(import_module(_LAZY[name]), name)
        raise AttributeError(f"module 'torchfilm' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
