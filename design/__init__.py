"""The design layer: name a scene, the parameters that may change and the pattern wanted, and
search.

    from design import Parameter, Search, Stripe

Uses torchfilm's public names only, as its users would.
"""

from design.methods import CMAES, Batch, Bayesian, Method, Racing, Sobol
from design.objective import Evaluation, Objective
from design.parameters import Choice, Parameter, Space
from design.robust import Robustness, robustness
from design.rollout import FinishedColonies
from design.search import Best, Search
from design.study import Study
from design.targets import (
    Bands,
    DomainSize,
    Gradient,
    Image,
    OnFraction,
    Oscillation,
    ProfileTarget,
    Ring,
    Stripe,
    Target,
)

__all__ = [
    "CMAES",
    "Bands",
    "Batch",
    "Bayesian",
    "Best",
    "Choice",
    "DomainSize",
    "Evaluation",
    "FinishedColonies",
    "Gradient",
    "Image",
    "Method",
    "Objective",
    "OnFraction",
    "Oscillation",
    "Parameter",
    "ProfileTarget",
    "Racing",
    "Ring",
    "Robustness",
    "Search",
    "Sobol",
    "Space",
    "Stripe",
    "Study",
    "Target",
    "robustness",
]
