"""Circuits from SBML and Antimony, and back: models of systems biology in their standard form."""

from torchfilm.circuits.sbml.antimony_text import looks_like_antimony
from torchfilm.circuits.sbml.antimony_text import to_sbml as antimony_to_sbml
from torchfilm.circuits.sbml.document import decoded, read_bytes, shortened
from torchfilm.circuits.sbml.reading import Description, Given, describe, variable_names
from torchfilm.circuits.sbml.writing import names_read, read_of_cell, sbml_text, usual_cell, write

__all__ = [
    "Description", "Given", "antimony_to_sbml", "decoded", "describe", "looks_like_antimony",
    "names_read", "read_bytes", "read_of_cell", "sbml_text", "shortened", "usual_cell",
    "variable_names", "write",
]  # fmt: skip
