"""Memory that a process keeps, where the C library has no such setting."""

import ctypes

import pytest

import torchfilm as tf


@pytest.mark.parametrize("error", [TypeError, OSError, AttributeError])  # the first on Windows
def test_other_c_libraries_are_left_alone(monkeypatch, error):
    def refuse(name):
        raise error

    monkeypatch.setattr(ctypes, "CDLL", refuse)
    assert tf.keep_memory() is False
