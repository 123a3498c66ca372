"""The glance at a call agrees with binding it."""

from __future__ import annotations

import inspect

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchfilm.tools.call_fits import CallFits


def one(a, b, c=1, *, d, e=2): ...
def two(): ...
def three(a=1): ...
def four(*, d): ...
def many(a, *others, d=1): ...
def named(a, **others): ...
def placed(a, /, b): ...


def binds(signature, args, names) -> bool:
    try:
        signature.bind(*args, **dict.fromkeys(names, 0))
    except TypeError:
        return False
    return True


@pytest.mark.parametrize("function", [one, two, three, four])
@settings(max_examples=300, deadline=None, derandomize=True)
@given(count=st.integers(0, 5), names=st.sets(st.sampled_from("abcdef")))
def test_a_call_fits_where_it_binds(function, count, names):
    signature = inspect.signature(function)
    found = CallFits(signature).fits((0,) * count, dict.fromkeys(names, 0))
    assert found == binds(signature, (0,) * count, names)


@pytest.mark.parametrize("function", [many, named, placed])
def test_other_kinds_of_parameters_are_left_to_binding(function):
    assert not CallFits(inspect.signature(function)).fits((0,), {})
    assert not CallFits(inspect.signature(function)).fits((0, 0), {})
