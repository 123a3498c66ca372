"""Circuits: reactions inside cells and their integrators. Tensors in and out, never a State."""

# Suffixes of the files of models.
SBML_FILES, ANTIMONY_FILES = (".xml", ".sbml"), (".ant", ".antimony")
