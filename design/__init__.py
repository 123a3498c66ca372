"""The design layer: name a scene, the parameters that may change and the pattern wanted, and
search.

    from design import Parameter, Search, Stripe

Uses torchfilm's public names only, as its users would.
"""

from design.colonies import Done
from design.methods import CMAES, Batch, Bayesian, Method, Racing, Sobol
from design.objective import Evaluation, Objective
from design.parameters import Choice, Parameter, Space
from design.robust import Robustness, robustness
from design.search import Best, Search
from design.study import Study
from design.targets import (
    Bands,
    DomainSize,
    Gradient,
    Image,
    Mask,
    OnFraction,
    Oscillation,
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
    "Done",
    "Evaluation",
    "Gradient",
    "Image",
    "Mask",
    "Method",
    "Objective",
    "OnFraction",
    "Oscillation",
    "Parameter",
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
