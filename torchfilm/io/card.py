"""How a results file displays itself in a notebook."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchfilm.tools import displays

if TYPE_CHECKING:
    from torchfilm.io.results import Results


def card(results: Results, fields: tuple[str, ...]) -> str:
    """Scene, cells, `fields`, signals, seed and version of an open file, as HTML."""
    attributes, hidden = results.attributes, results.internal_fields
    about = [("scene", str(attributes["scene"]).splitlines()[0])]
    if len(results):
        first, last = results.counts[0].sum(), results.counts[-1].sum()
        about += [("cells", f"{first} at first, {last} at last")]
    about += [
        ("fields", ", ".join(n for n in fields if n not in hidden)),
        ("signals", ", ".join(results.signal_names)),
        ("seed", str(attributes["seed"])),
        ("torchfilm", str(attributes["torchfilm"])),
    ]
    return displays.card(repr(results), displays.pairs((n, v) for n, v in about if v))
