"""CellModeller 4 scripts as scenes: a script runs with stand-ins that record what it asks for."""

from torchfilm.cellmodeller.build import from_cellmodeller
from torchfilm.cellmodeller.loading import is_script
from torchfilm.cellmodeller.variables import own_colour

__all__ = ["from_cellmodeller", "is_script", "own_colour"]
