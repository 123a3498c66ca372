"""Messages of the input checks that several modules share."""

from __future__ import annotations

import pytest

from torchfilm.tools.checks import InputError, unknown_keyword


@pytest.mark.parametrize(
    "given, allowed, message",
    [
        (
            "rat",
            ("rate", "law"),
            "Growth has no parameter 'rat'. Did you mean rate? It has: rate, law.",
        ),
        ("colour", ("rate",), "Growth has no parameter 'colour'. It has: rate."),
        (
            "dimension",
            ("walls", "dim"),
            "Growth has no parameter 'dimension'. Did you mean dim? It has: walls, dim.",
        ),
        ("rate", (), "Growth has no parameter 'rate'. It has: none."),
    ],
)
def test_an_unknown_keyword_gets_the_nearest_known_one(given, allowed, message):
    error = unknown_keyword("Growth", given, allowed)
    assert isinstance(error, InputError) and str(error) == message
