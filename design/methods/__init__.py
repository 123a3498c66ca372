"""Search methods: each proposes batches of points and learns their losses."""

from __future__ import annotations

from typing import Any

from design.methods.auto import Chosen, choose
from design.methods.base import Batch, Method
from design.methods.bayesian import Bayesian
from design.methods.cmaes import CMAES
from design.methods.exhaustive import Exhaustive, designs_of
from design.methods.gauss_newton import GaussNewton
from design.methods.local import Local
from design.methods.nsga2 import NSGA2
from design.methods.polish import Polish
from design.methods.racing import Racing
from design.methods.sobol import Sobol
from torchfilm import checks

METHODS: dict[str, type[Any]] = {
    "sobol": Sobol,
    "cmaes": CMAES,
    "bayesian": Bayesian,
    "racing": Racing,
    "local": Local,
    "polish": Polish,
    "gauss-newton": GaussNewton,
    "nsga2": NSGA2,
    "exhaustive": Exhaustive,
}

__all__ = [
    "CMAES",
    "METHODS",
    "NSGA2",
    "Batch",
    "Bayesian",
    "Chosen",
    "Exhaustive",
    "GaussNewton",
    "Local",
    "Method",
    "Polish",
    "Racing",
    "Sobol",
    "choose",
    "designs_of",
    "method_of",
]


def method_of(given: str | Method) -> Method:
    """A method, from its name or from an object with start, ask and tell. Raises InputError for
    anything else."""
    if isinstance(given, str):
        checks.choice("method", given, tuple(METHODS))
        made: Method = METHODS[given]()
        return made
    missing = [
        name for name in ("start", "ask", "tell") if not callable(getattr(given, name, None))
    ]
    if isinstance(given, type) or missing:
        raise checks.input_error(
            "method",
            given,
            "one of " + ", ".join(map(repr, METHODS)) + ", or an object with start, ask and tell",
            (
                "This is a class; make an object of it: CMAES()."
                if isinstance(given, type)
                else f"It has no {' and no '.join(missing)}."
            ),
        )
    return given
