"""The design layer: search the parameters of a scene for colonies that form a pattern.

    from design import Parameter, Search, Stripe

It uses torchfilm's public names only, as any user can.
"""

from design.best import Best
from design.calibration import Calibration
from design.finals import Finals
from design.front import Front
from design.growing import FinishedColonies
from design.inference import infer
from design.intervals import Intervals
from design.library import Library, Sensor, SensorDevice, Wiring
from design.methods import (
    CMAES,
    NSGA2,
    Batch,
    Bayesian,
    Exhaustive,
    GaussNewton,
    Local,
    Method,
    Polish,
    Racing,
    Sobol,
)
from design.objective import Evaluation, Objective
from design.parameters import Choice, Parameter, Space
from design.posterior import Posterior
from design.prediction import Prediction
from design.robustness import Robustness
from design.robustness_check import check_robustness
from design.saved_design import SavedDesign, load_design
from design.scene_family import UnfitDesign
from design.search import Search
from design.slopes import Slopes
from design.study import Study
from design.targets import (
    Bands,
    Burden,
    Composition,
    Conditions,
    Constrained,
    DomainSize,
    Duration,
    Gradient,
    Image,
    Lasting,
    Measured,
    Observed,
    ObservedCourse,
    ObservedCycles,
    OnFraction,
    Oscillation,
    ProfileTarget,
    Ring,
    Spread,
    Stripe,
    Target,
    Weighted,
)
from design.task import Task
from design.weights import load_weights, save_weights

__all__ = [
    "CMAES",
    "NSGA2",
    "Bands",
    "Batch",
    "Bayesian",
    "Best",
    "Burden",
    "Calibration",
    "Choice",
    "Composition",
    "Conditions",
    "Constrained",
    "DomainSize",
    "Duration",
    "Evaluation",
    "Exhaustive",
    "Finals",
    "FinishedColonies",
    "Front",
    "GaussNewton",
    "Gradient",
    "Image",
    "Intervals",
    "Lasting",
    "Library",
    "Local",
    "Measured",
    "Method",
    "Objective",
    "Observed",
    "ObservedCourse",
    "ObservedCycles",
    "OnFraction",
    "Oscillation",
    "Parameter",
    "Polish",
    "Posterior",
    "Prediction",
    "ProfileTarget",
    "Racing",
    "Ring",
    "Robustness",
    "SavedDesign",
    "Search",
    "Sensor",
    "SensorDevice",
    "Slopes",
    "Sobol",
    "Space",
    "Spread",
    "Stripe",
    "Study",
    "Target",
    "Task",
    "UnfitDesign",
    "Weighted",
    "Wiring",
    "check_robustness",
    "infer",
    "load_design",
    "load_weights",
    "save_weights",
]
