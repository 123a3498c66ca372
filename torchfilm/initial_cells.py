"""Initial cells: given directly, from arrays, from tables or from label images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from torchfilm.physics.nearby import gaps_nearby
from torchfilm.physics.space import Faces, PeriodicSpace
from torchfilm.physics.walls import Wall
from torchfilm.state import CELL_TYPE, RESERVED, Field, State
from torchfilm.tools import checks, displays
from torchfilm.tools.row_checks import warn_of_rounding, without_gradient
from torchfilm.tools.tables import Table
from torchfilm.tools.warn_once import warn

if TYPE_CHECKING:
    from torchfilm.micrographs.record import Micrograph

GIVEN = "given with the first cells"  # what a field means that they bring


@dataclass(frozen=True, repr=False)
class Cells(metaclass=checks.KnownKeywords):
    """Initial cells.

    position: (N, d) µm. axis: (N, d), of any length above 0. length: (N,) µm of the centreline.
    radius: (N,) µm. cell_type: (N,) integers or None. colony: (N,) or None. extra: further fields
    by name, (N,) each. With a colony for each cell, a batch has as many colonies as the greatest
    number requires. Without it, every colony starts from a copy of all cells. micrograph: where the
    cells lie in the image that they were read from, if they were. Raises InputError for invalid
    values.
    """

    position: Any
    axis: Any
    length: Any = 2.0
    radius: Any = 0.5
    cell_type: Any = None
    colony: Any = None
    extra: Mapping[str, Any] = field(default_factory=dict)
    # repr=False: it has no effect on a simulation, so it does not count for a scene's digest
    micrograph: Micrograph | None = field(default=None, repr=False)

    instead: ClassVar[Mapping[str, str]] = {
        "angle": "Write axis=[[cos, sin], …], or Cells.from_table({'angle': …, …})."
    }

    def __post_init__(self) -> None:
        position = _array("position", self.position, np.float64)
        if position.ndim != 2 or position.shape[1] not in (2, 3):
            raise checks.input_error(
                "Cells.position", f"an array of shape {position.shape}", "of shape (N, 2) or (N, 3)"
            )
        count = position.shape[0]
        axis = _array("axis", self.axis, np.float64)
        # for two cells in the plane two numbers may be angles, unless they are a unit vector
        angles = axis.shape == (2,) == (count,) and abs((axis**2).sum() - 1.0) >= 1e-3
        if axis.shape == position.shape[1:] and not angles:
            axis = np.broadcast_to(axis, position.shape)
        if axis.shape != position.shape:
            given = f"{axis.tolist()} for two cells" if angles else f"an array of {axis.shape}"
            rule = f"of shape {position.shape}, like position"
            raise checks.input_error("Cells.axis", given, rule, self.instead["angle"])
        size = np.sqrt((axis**2).sum(1))
        if (size == 0).any():
            at, rule = int(np.argmin(size)), "a direction that is not zero"
            raise checks.input_error(f"Cells.axis[{at}]", axis[at].tolist(), rule)
        parts: dict[str, Any] = {"position": position, "axis": axis / size[:, None]}
        for name, above in (("length", False), ("radius", True)):
            values = _column(name, getattr(self, name), count, or_one=True)
            bad = np.flatnonzero(values <= 0 if above else values < 0)
            if bad.size:
                raise checks.input_error(
                    f"Cells.{name}[{bad[0]}]",
                    float(values[bad[0]]),
                    "above 0" if above else "at least 0",
                    "In µm; length is the centreline's, without caps.",
                )
            parts[name] = values
        for name in ("cell_type", "colony"):
            if getattr(self, name) is not None:
                values = _column(name, getattr(self, name), count)
                bad = np.flatnonzero((values != np.round(values)) | (values < 0))
                if bad.size:
                    raise checks.input_error(
                        f"Cells.{name}[{bad[0]}]", float(values[bad[0]]), "a whole number from 0"
                    )
                parts[name] = values.astype(np.int64)
        if "colony" in parts:
            _check_colonies(parts["colony"])
        for name in self.extra:
            if not name.isidentifier() or name in RESERVED:
                raise checks.input_error(
                    "Cells column",
                    name,
                    "a name that the state does not use itself",
                    "Rename or delete it; of a table, fields=[…] says which columns to take.",
                )
        parts["extra"] = {name: _column(name, values, count) for name, values in self.extra.items()}
        for name, values in parts.items():
            object.__setattr__(self, name, values)

    @staticmethod
    def single(dim: int, length: float = 2.0, radius: float = 0.5) -> Cells:
        """One cell at the origin along x."""
        return Cells(np.zeros((1, dim)), np.eye(dim)[:1], length, radius)

    @property
    def count(self) -> int:
        return self.position.shape[0]

    @property
    def colonies(self) -> int:
        """The least number of colonies that the cells require; 1 without colony numbers."""
        return int(self.colony.max()) + 1 if self.colony is not None and self.count else 1

    @property
    def dim(self) -> int:
        return self.position.shape[1]

    def batch_size(self, colonies: int) -> int:
        """How many colonies a batch of `colonies` has; 1 stands for as many as the cells require.
        Raises InputError for fewer."""
        if colonies not in (1, self.colonies) and colonies < self.colonies:
            raise checks.input_error(
                "colonies",
                colonies,
                f"at least {self.colonies}, since a cell has colony {self.colonies - 1}",
            )
        return max(colonies, self.colonies)

    def state(self, colonies: int, seed: int, device: torch.device, dtype: torch.dtype) -> State:
        """The state of these cells, with no fields except cell_type and the extra columns."""
        if self.colony is None:
            index = np.tile(np.arange(self.count), colonies)
            colony = np.repeat(np.arange(colonies), self.count)
        else:
            if (colonies := self.batch_size(colonies)) > self.colonies:
                _warn_of_empty(self, colonies)
            index = np.argsort(self.colony, kind="stable")
            colony = self.colony[index]
        counts = np.bincount(colony, minlength=colonies)
        uid = np.arange(len(index)) - np.repeat(np.cumsum(counts) - counts, counts)

        def tensor(values: np.ndarray, dtype: torch.dtype) -> Tensor:
            return torch.as_tensor(np.array(values[index]), dtype=dtype, device=device)

        state = State(
            colony=torch.as_tensor(colony, dtype=torch.int64, device=device),
            uid=torch.as_tensor(uid, dtype=torch.int64, device=device),
            parent=torch.full((len(index),), -1, dtype=torch.int64, device=device),
            position=tensor(self.position, torch.float64),
            axis=tensor(self.axis, dtype),
            length=tensor(self.length, dtype),
            radius=tensor(self.radius, dtype),
            colony_id=torch.arange(colonies, device=device),
            stream=torch.arange(colonies, device=device),
            next_uid=torch.as_tensor(counts, dtype=torch.int64, device=device),
            seed=seed,
        )
        axis = state.axis / (state.axis * state.axis).sum(1, keepdim=True).sqrt()
        state = state.replace(axis=axis)
        if self.cell_type is not None:
            state = state.declare(CELL_TYPE).with_fields(
                cell_type=tensor(self.cell_type, torch.int64)
            )
        for name, values in self.extra.items():
            warn_of_rounding(f"the first cells' column {name!r}", values, dtype)
            state = state.declare(Field(name, GIVEN)).with_fields(**{name: tensor(values, dtype)})
        return state

    def overlaps(
        self, depth: float = 0.0, *, periodic: Faces | None = None
    ) -> list[tuple[int, int, float]]:
        """Pairs of cells that overlap by more than `depth` µm, deepest first: (cell, cell, µm).
        periodic: as of `Mechanics`."""
        space = PeriodicSpace.of("Cells.overlaps(periodic)", periodic, self.dim)
        t = lambda x: torch.as_tensor(np.array(x))
        position, axis = t(self.position), t(self.axis)
        length, radius = t(self.length), t(self.radius)
        one = torch.zeros(self.count, dtype=torch.int64)
        colony = one if self.colony is None else t(self.colony)
        i, j, gap = gaps_nearby(position, axis, length, radius, colony, self.colonies, space=space)
        order = torch.argsort(gap)
        return [(int(i[k]), int(j[k]), -float(gap[k])) for k in order.tolist() if gap[k] < -depth]

    @staticmethod
    @checks.known_keywords
    def from_table(
        table: Any,
        *,
        pixel_size: float | None = None,
        length_unit: str | None = None,
        columns: str | Mapping[str, str] | None = None,
        angle_unit: str | None = None,
        angle_turns: str | None = None,
        y: str | None = None,
        length_with_caps: bool = False,
        radius: float | None = None,
        frame: int | float | str | None = None,
        fields: Sequence[str] | Mapping[str, str] | None = None,
        centre: bool = False,
    ) -> Cells:
        """Cells from a table with one row for each: a CSV file with a header, or columns by name (a
        dictionary, or a pandas.DataFrame).

        Columns: x, y and, in space, z; length, of the centreline; angle, from +x, or axis_x, axis_y
        and, in space, axis_z; optional radius or width, cell_type, colony, label, frame. columns:
        their names in the table where they differ, such as {"x": "cx"}; or the set of a program,
        "skimage" (regionprops_table; the cell is the capsule with the same second moments, and with
        the same area where the table has it) or "matlab" (regionprops).

        Units stand in the names of columns (x_um or x_px, angle_deg or angle_rad) or in arguments:
        pixel_size, µm a pixel; length_unit "um"; angle_unit "degrees" or "radians". y: "up" (the
        default) or "down", as in images; then y changes its sign, so that the centre of the first
        pixel is the origin. angle_turns: "clockwise" or "counterclockwise" as seen; default
        from +x towards the table's +y. length_with_caps: lengths include both caps, as masks
        measure them. radius: µm, of all cells, where no column gives it; default 0.5. centre: move
        the mean of the centres of each colony to the origin.

        frame: the cells to take, of a table with several frames. Labels name cells in messages.
        fields: further columns that become fields of the cells, by name or {"field": "column"};
        without `columns`, by default all others, but never those that number cells or frames, and
        of a table of torchfilm's results not what belongs to the run, nor signals outside.

        Raises InputError for a column that is missing, has no unit, is not numbers or is used
        twice, for rows with one label or one place, for several frames, and for arguments that
        nothing uses. Warns of angles that cannot be in their unit, and of widths and lengths that
        no bacteria have.
        """
        from torchfilm.micrographs.cell_tables import Reading, table_cells
        from torchfilm.micrographs.record import with_usual_sizes

        reading = Reading(
            pixel_size, length_unit, columns, angle_unit, angle_turns, y, length_with_caps, radius,
            frame, fields, centre,
        )  # fmt: skip
        cells = with_usual_sizes(Cells(**table_cells(Table.read(table), reading)))
        _warn_of_empty(cells)
        return cells

    @staticmethod
    @checks.known_keywords
    def from_masks(
        image: Any,
        *,
        pixel_size: float | None = None,
        fluorescence: Mapping[str, Any] | None = None,
        background: str | float = "median",
        frame: int | None = None,
        drop: str | Sequence[str] = (),
        least_area: int = 30,
        centre: bool = False,
    ) -> Cells:
        """Cells from a label image: 0 between the cells, and a number for each cell. A cell is the
        capsule with the centre and area of its region, its axis and its second moment along that.
        Requires the extra `images`.

        image: an array (rows, columns) of whole numbers; a file .tif, .png or .npy (of Omnipose or
        Cellpose: NAME_cp_masks.tif); or a results file .nc of DeLTA. pixel_size: µm a pixel, None
        for what an OME-TIFF or a TIFF of ImageJ states. frame: of a stack, −1 is the
        last; of DeLTA, the number that it gave. The centre of the first pixel is the origin, x goes
        to the right and y up, so that cells have y ≤ 0. centre: move the mean of the centres to the
        origin.

        fluorescence: images of the mask's shape by field, {"gfp": "gfp.tif"}; frame picks from
        them, too. Each cell gets the field `gfp`, the mean of the pixels in its region less the
        background. background: "median", of the pixels outside of all regions; or counts, of which
        0 leaves the pixels as they are.

        Regions smaller than least_area pixels ("tiny") or in several "pieces" raise InputError.
        Regions at the "border" of the image, or of which over 15 % of the area is outside of the
        capsule or missing in it ("misfit": curved, or several cells in one), give a warning with
        their labels. drop: the kinds to leave out instead, such as "border" or ("border", "tiny").
        """
        from torchfilm.micrographs.masks import mask_cells
        from torchfilm.micrographs.record import with_usual_sizes

        given = mask_cells(
            image,
            pixel_size=pixel_size,
            fluorescence=fluorescence,
            background=background,
            frame=frame,
            drop=drop,
            least_area=least_area,
            centre=centre,
        )
        return with_usual_sizes(Cells(**given))

    @staticmethod
    @checks.known_keywords
    def from_hdf5(
        path: str | Path,
        group: str = "/",
        *,
        pixel_size: float | None = None,
        length_unit: str | None = None,
        angle_unit: str | None = None,
    ) -> Cells:
        """Cells from an HDF5 file with one data set per column in `group`. Columns and units: as
        for `from_table`."""
        import h5py

        try:
            opened = h5py.File(path, "r")
        except OSError as error:
            reason = "no such file" if not Path(path).exists() else error
            raise checks.InputError(f"{path} cannot be read as HDF5 ({reason}).") from error
        with opened as file:
            checks.only_own_data(file)
            if not isinstance(file.get(group), h5py.Group):
                raise checks.input_error("group", group, f"a group of {path}")
            parts = {n: d for n, d in file[group].items() if isinstance(d, h5py.Dataset)}
            try:
                columns = {n: np.asarray(d) for n, d in parts.items()}
            except (OSError, MemoryError, ValueError) as error:
                raise checks.InputError(f"{path} cannot be read as HDF5 ({error}).") from error
        from torchfilm.micrographs.cell_tables import Reading, table_cells

        reading = Reading(pixel_size, length_unit, angle_unit=angle_unit)
        cells = Cells(**table_cells(Table.read(columns, str(path)), reading))
        _warn_of_empty(cells)
        return cells

    def relaxed(
        self, depth: float = 0.01, walls: Sequence[Wall] = (), *, periodic: Faces | None = None
    ) -> Cells:
        """The same cells, pushed apart until none overlap by more than `depth` µm, and out of the
        walls of a scene, soft ones too: `cells.relaxed(walls=[tf.Channel(…)])`. periodic: as of
        `Mechanics`. Lengths and radii do not change; one-sided contacts move and turn the cells.
        `summary` says how far cells of a micrograph moved.

        Raises SimulationError if they still overlap after 200 steps.
        """
        from torchfilm.micrographs.relaxing import relax

        return relax(self, depth, walls, periodic)

    def table(self) -> dict[str, np.ndarray]:
        """The cells as columns (N,) with their units in the names, for `from_table`, for
        `design.Observed.from_table` or for a DataFrame: x_um, y_um, z_um in space, length_um (of
        the centreline), radius_um, the axis (in the plane angle_rad), cell_type and colony where
        given, and the further fields."""
        columns = {f"{n}_um": self.position[:, k] for k, n in enumerate("xyz"[: self.dim])}
        columns |= {"length_um": self.length, "radius_um": self.radius}
        if self.dim == 2:
            columns["angle_rad"] = np.arctan2(self.axis[:, 1], self.axis[:, 0])
        else:
            columns |= {f"axis_{n}": self.axis[:, k] for k, n in enumerate("xyz")}
        for name in ("cell_type", "colony"):
            if getattr(self, name) is not None:
                columns[name] = getattr(self, name)
        return columns | dict(self.extra)

    def __repr__(self) -> str:
        of = "" if self.colony is None else f" of {self.colonies} colonies"
        more = f", with {', '.join(self.extra)}" if self.extra else ""
        return f"Cells({self.count} cells{of}, {self.dim}-D{more})"

    def _repr_html_(self) -> str:
        return displays.card(repr(self), displays.lines(self.summary()))

    def summary(self) -> str:
        """What was read, for checking: counts, sizes and extent in µm, what was left out, overlaps,
        and how far `relaxed` moved the cells."""
        from torchfilm.micrographs.record import summarise

        return summarise(self)


# numbers of colonies up to it may leave any out
MANY = 100_000


def _check_colonies(colony: np.ndarray) -> None:
    """Raise InputError for numbers that are names, such as 20250131: a batch holds all up to it."""
    if colony.size and (greatest := int(colony.max())) >= max(MANY, 10 * colony.size):
        raise checks.input_error(
            "Cells.colony",
            greatest,
            f"below {max(MANY, 10 * colony.size)}: a batch has all colonies up to that number",
            "Number them from 0: numpy.unique(colony, return_inverse=True)[1].",
        )


def _warn_of_empty(cells: Cells, colonies: int = 0) -> None:
    """Warn of colonies without a cell: of those up to the greatest number, or of more."""
    if cells.colony is None:
        return
    counts = np.bincount(cells.colony, minlength=colonies)
    empty, there = np.flatnonzero(counts == 0), np.flatnonzero(counts)
    if empty.size:
        warn(
            f"{_colonies(empty)} of {len(counts)} {'stays' if empty.size == 1 else 'stay'} empty:"
            f" the cells are of {_colonies(there)} only. Number colonies from 0."
        )


def _colonies(numbers: np.ndarray, most: int = 12) -> str:
    more = f", … ({len(numbers)} in all)" if len(numbers) > most else ""
    listed = ", ".join(map(str, numbers[:most].tolist())) + more
    return f"{'colony' if len(numbers) == 1 else 'colonies'} {listed}"


def _array(name: str, given: Any, dtype: type) -> np.ndarray:
    """An array of finite numbers, or InputError."""
    try:
        given = without_gradient(f"Cells.{name}", given)
        values: np.ndarray = np.asarray(given, dtype=dtype).copy()  # the caller may change its own
    except (TypeError, ValueError) as error:
        raise checks.input_error(f"Cells.{name}", given, "an array of numbers") from error
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        at = tuple(int(k) for k in bad[0])
        entry = f"[{', '.join(map(str, at))}]" if at else ""
        raise checks.input_error(f"Cells.{name}{entry}", float(values[at]), "finite")
    return values


def _column(name: str, given: Any, count: int, *, or_one: bool = False) -> np.ndarray:
    """An array of shape (count,), or InputError. or_one: one number is that of all cells."""
    values = _array(name, given, np.float64)
    if or_one and values.ndim == 0:
        return np.broadcast_to(values, (count,))
    if values.shape != (count,):
        raise checks.input_error(
            f"Cells.{name}",
            f"an array of shape {values.shape}",
            f"of shape ({count},), one for each cell",
        )
    return values
