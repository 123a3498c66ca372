"""Measures take a state, and say so of anything else."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

from torchfilm.state import State
from torchfilm.tools import checks

F = TypeVar("F", bound=Callable[..., Any])


def of_a_state(function: F) -> F:
    """Let a measure raise InputError for a keyword that it does not take, and for what is no
    state."""

    @checks.known_keywords
    @functools.wraps(function)
    def checked(state: State, *args: Any, **given: Any) -> Any:
        if not isinstance(state, State):
            hint = "Such as the last one of tf.simulate(…), or scene.bind().start()."
            raise checks.input_error(f"{function.__name__}(state)", state, "a tf.State", hint)
        return function(state, *args, **given)

    return cast(F, checked)
