"""The cells that `torchfilm run SCENE --start FILE` starts from, of a file of any kind."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from torchfilm.cli.report import extra_columns_note, overlaps_note
from torchfilm.initial_cells import Cells
from torchfilm.io.reading import is_results
from torchfilm.io.results import Results
from torchfilm.model import Model
from torchfilm.tools import checks
from torchfilm.tools.checks import InputError

MASKS = (".tif", ".tiff", ".png", ".npy", ".nc")
# What messages about cells tell to give, and the same on the command line.
IN_A_SHELL = (
    ("pixel_size=…", "--pixel-size"),
    ("frame=…", "--frame"),
    ('Name it by columns={"frame": …}.', "Call the column frame."),
    ('length_unit="um"', "--length-unit um"),
    ('angle_unit="degrees" or "radians"', "--angle-unit degrees or radians"),
    ('angle_unit="degrees"', "--angle-unit degrees"),
    ('angle_unit="radians"', "--angle-unit radians"),
)
NOT_IN_A_SHELL = re.compile(r", or give columns=\{.*\}")


@dataclass
class StartCells:
    """Options about the cells to start from."""

    start: Path | None = None
    """File of cells to start from: a table (.csv, or .h5 with a data set for each column), whose
    units stand in the names of its columns (x_um, angle_rad, …) or in the options below; a label
    image (.tif, .png, .npy, or .nc of DeLTA); or a results file, of which it takes one frame."""
    frame: int | None = None
    """Of --start: which frame of several. Of a results file, −1 (the last) is the default."""
    pixel_size: float | None = None
    """Of --start: µm a pixel, of a label image, or of a table whose lengths are in pixels."""
    length_unit: str | None = None
    """Of --start: um, if the lengths of a table are in µm."""
    angle_unit: str | None = None
    """Of --start: degrees or radians, of a table."""

    def read(self) -> Cells | None:
        """The cells to start from, if any. Raises InputError for options that nothing uses."""
        given = {n: getattr(self, n) for n in ("pixel_size", "length_unit", "angle_unit", "frame")}
        given = {name: value for name, value in given.items() if value is not None}
        if self.start is None:
            for name, value in given.items():
                raise checks.input_error(_option(name), value, "left out without --start")
            return None
        try:
            return _read(self.start, given)
        except InputError as error:
            said = str(error)
            for words, option in IN_A_SHELL:
                said = said.replace(words, option)
            said = NOT_IN_A_SHELL.sub("", said)
            raise InputError(said) from error

    def print_notes(self, cells: Cells | None, model: Model) -> None:
        """Print what a user should know of the cells that a run starts from."""
        if cells is None:
            return
        for note in (extra_columns_note(str(self.start), cells, model), overlaps_note(cells)):
            if note:
                print(f"note: {note}")


# the options of the class stand among those of the command
Options = Annotated[StartCells, tyro.conf.arg(name="")]


def _read(path: Path, given: dict[str, Any]) -> Cells:
    if not path.is_file():
        raise checks.input_error("--start", str(path), "a file of cells", "No such file.")
    kind = path.suffix.lower()
    if kind == ".csv":
        return Cells.from_table(path, **given)
    if kind in MASKS:
        _leave_out(given, path, "a label image", "length_unit", "angle_unit")
        return Cells.from_masks(path, **given)
    if is_results(path):
        _leave_out(given, path, "a results file", "pixel_size", "length_unit", "angle_unit")
        with Results(path) as results:
            return results.cells(**given)
    _leave_out(given, path, "a table in HDF5", "frame")
    return Cells.from_hdf5(path, **given)


def _leave_out(given: dict[str, Any], path: Path, what: str, *names: str) -> None:
    for name in names:
        if name in given:
            raise checks.input_error(
                _option(name), given[name], f"left out: {path} is {what}, which has none"
            )


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"
