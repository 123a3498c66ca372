"""Subnormal numbers count as 0 where it is asked for, in all threads alike, and nowhere else."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch

from torchfilm.tools import subnormals
from torchfilm.tools.threads import submit

# too small for the usual form of float32, and of float64
TINY = {np.float32: 1e-40, np.float64: 1e-310}


def are_kept() -> list[bool]:
    """Whether a product that is subnormal is kept, by type."""
    return [bool((np.full(3, x, t) * np.full(3, 0.5, t)).all()) for t, x in TINY.items()]


@pytest.fixture(autouse=True)
def there_is_a_choice():
    if not torch.set_flush_denormal(True):
        pytest.skip("this processor has no choice of what subnormal numbers are")
    torch.set_flush_denormal(False)
    yield
    torch.set_flush_denormal(False)


def test_they_are_zero_inside_only():
    assert are_kept() == [True, True] and not subnormals.are_zero()
    with subnormals.as_zero():
        assert are_kept() == [False, False] and subnormals.are_zero()
    assert are_kept() == [True, True] and not subnormals.are_zero()


def test_an_error_inside_changes_nothing_outside():
    with pytest.raises(ZeroDivisionError), subnormals.as_zero():
        raise ZeroDivisionError
    assert not subnormals.are_zero()


def test_what_a_user_chose_stays():
    torch.set_flush_denormal(True)
    with subnormals.as_zero():
        pass
    assert subnormals.are_zero()


def test_other_threads_count_as_this_one_does():
    with subnormals.as_zero():
        inside = submit(are_kept).result()
    assert inside == [False, False]
    assert submit(are_kept).result() == [True, True]


def test_it_does_not_matter_what_they_were_when_it_was_imported():
    """A subnormal number is read as 0 in a file that is compiled while they count as 0."""
    code = (
        "import torch; torch.set_flush_denormal(True)\n"
        "from torchfilm.tools import subnormals as s; here = s.are_zero()\n"
        "torch.set_flush_denormal(False)\n"
        "print(here, s.are_zero())"
    )
    ran = subprocess.run([sys.executable, "-B", "-c", code], capture_output=True, text=True)
    assert ran.stdout.split() == ["True", "False"], ran.stderr
