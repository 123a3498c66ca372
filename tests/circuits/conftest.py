"""Fixtures of the tests of circuits."""

from __future__ import annotations

import pytest
from traced import plain_module

from torchfilm.circuits import compiled


@pytest.fixture
def plain(monkeypatch):
    """The texts of circuits are run as Python: compiling them takes seconds each."""
    monkeypatch.setattr(compiled, "_module", plain_module)
