"""Circuits from SBML and Antimony, and back: models of systems biology in their standard form."""

from torchfilm.circuits.sbml.antimony_text import to_sbml as antimony_to_sbml
from torchfilm.circuits.sbml.document import decoded, read_bytes
from torchfilm.circuits.sbml.reading import Description, Given, describe
from torchfilm.circuits.sbml.writing import sbml_text, write

__all__ = [
    "Description", "Given", "antimony_to_sbml", "decoded", "describe", "read_bytes", "sbml_text",
    "write",
]  # fmt: skip
