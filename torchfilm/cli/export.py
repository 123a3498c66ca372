"""The command that writes results for other programs: `torchfilm export FILE OUT`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from torchfilm.io.new_file import check_frames, check_new_file
from torchfilm.io.results import Results
from torchfilm.io.table import Tables, data_frame, needed
from torchfilm.tools import checks
from torchfilm.tools.checks import InputError
from torchfilm.tools.whole_files import write_whole, written_whole

TABLE, NEWICK, GRAPH, VTK = ".csv", ".nwk", ".graphml", ".vtkhdf"
LIVES, COLONIES = ".lineage.csv", ".colonies.csv"
IMAGES = (".tif", ".tiff")
SUFFIXES = (TABLE, LIVES, COLONIES, NEWICK, GRAPH, VTK, *IMAGES)
FOLDER = ""  # ground truth for segmentation and tracking is a folder, which has no suffix
# Options of each format, beside --overwrite.
PAGES = ("frames", "colonies", "pixel_size", "window")
LIGHT = ("channels", "blur", "noise", "background", "offset", "profile", "seed")
OPTIONS: dict[str, tuple[str, ...]] = {
    TABLE: ("frames", "internals"),
    LIVES: (),
    COLONIES: ("frames", "internals"),
    NEWICK: ("colonies",),
    GRAPH: ("colonies",),
    VTK: ("frames", "colonies", "rods"),
    "label masks": (*PAGES, "z"),
    "fluorescence": (*PAGES, *LIGHT),
    FOLDER: (*PAGES, "z", *LIGHT),
}


@dataclass
class Export:
    """Write results for other programs. The suffix of the new file says the format: .csv, the
    table of cells, frame by frame; .colonies.csv, one row per colony and frame: its cells, deaths
    and means; .lineage.csv, one row per cell: when it was born and ended, how long it was then, and
    its fate; .vtkhdf, for ParaView and pyvista; .tif or .ome.tif, label
    masks, or fluorescence where --channels are given; .nwk, the lineage in Newick format; .graphml,
    the lineage as a graph. A name without a dot, such as ctc/, is a folder in the format of the
    Cell Tracking Challenge: images, label masks and tracks."""

    file: Annotated[Path, tyro.conf.Positional]
    """Results file."""
    out: Annotated[Path, tyro.conf.Positional]
    """The new file: NAME.csv, .colonies.csv, .lineage.csv, .vtkhdf, .tif, .ome.tif, .nwk or
    .graphml; or the new folder."""
    frames: list[str] = field(default_factory=list)
    """Which frames, such as --frames 0 10 -1, or ranges START:STOP or START:STOP:STEP as in Python,
    such as --frames 2:5 or --frames=-3:; by default all. (Not .lineage.csv, .nwk, .graphml.)"""
    colonies: list[int] = field(default_factory=list)
    """Which colonies, by their ids; by default all. Images need one, if the run has several; .nwk
    and .graphml take one or all. (Not for tables.)"""
    pixel_size: float | None = None
    """Images: width of a pixel, µm."""
    window: list[float] = field(default_factory=list)
    """Images: the part to show, as LEFT BOTTOM RIGHT TOP, µm; by default the colony."""
    z: float | None = None
    """Label masks and folders, in space: height of the section, µm."""
    channels: list[str] = field(default_factory=list)
    """Fluorescence: quantities and gains, as NAME=GAIN, such as --channels gfp=100 rfp=50: counts
    per µm of cell and unit of the quantity. Folders: one, by default a dye that all cells hold
    alike."""
    blur: float | None = None
    """Fluorescence: σ of the optics, µm; by default 0."""
    noise: float | None = None
    """Fluorescence: σ of reading a pixel, counts; the photons' noise comes with it. By default
    there is no noise."""
    background: float | None = None
    """Fluorescence: light beside the cells, counts; by default 0."""
    offset: float | None = None
    """Fluorescence: counts that the camera adds; by default 100."""
    profile: str | None = None
    """Fluorescence: thickness (the default), or flat, where the thickness of a cell does not
    count."""
    seed: int | None = None
    """Fluorescence: seed of the noise; by default 0."""
    rods: str | None = None
    """.vtkhdf: capsules (the default), or lines, which take less space."""
    internals: bool = False
    """.csv, .colonies.csv: with the fields that serve the numerics."""
    overwrite: bool = False
    """Replace the file or the folder if it exists."""

    def __call__(self) -> None:
        suffix = self.out.suffix.lower()
        if suffix not in (*SUFFIXES, FOLDER):
            rule = f"a name that ends in {', '.join(SUFFIXES)}, or that of a folder, without a dot"
            raise checks.input_error("OUT", str(self.out), rule)
        name = self.out.name.lower()
        form = next((own for own in (LIVES, COLONIES) if name.endswith(own)), suffix)
        if suffix in IMAGES:
            form = "fluorescence" if self.channels else "label masks"
        self._check_options(form)
        writers: dict[str, Callable[[Results], Any]] = {
            TABLE: self._table,
            LIVES: self._lives,
            COLONIES: self._colonies,
            NEWICK: self._newick,
            GRAPH: self._graph,
            VTK: self._vtk,
            "label masks": self._labels,
            "fluorescence": self._fluorescence,
            FOLDER: self._folder,
        }
        with Results(self.file) as results:
            for path in writers[form](results):
                print(path)
        if form == "label masks":
            print(
                "label masks, in which a cell is its number + 1; for fluorescence give --channels"
            )
        if form == FOLDER:
            what = "images, label masks and tracks" if self.z is None else "label masks and tracks"
            print(f"{what}; cells.csv says which cell a label is")

    def _check_options(self, form: str) -> None:
        """Raise InputError for options that this format does not have."""
        own = {"file", "out", "overwrite", *OPTIONS[form]}
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        unset = {n: v is None or v is False or v == [] for n, v in values.items()}
        given = [n for n in values if n not in own and not unset[n]]
        if given:
            flags = ", ".join("--" + name.replace("_", "-") for name in given)
            hint = (
                " Light needs --channels."
                if form == "label masks" and set(given) & {*LIGHT}
                else ""
            )
            raise InputError(
                f"{flags}: not for {self.out.name}, which holds {_content(form)}.{hint}"
            )

    def _frames(self, results: Results) -> list[int] | None:
        """The numbers of the chosen frames; None, all."""
        if not self.frames:
            return None
        count = len(results)
        chosen = [k for text in self.frames for k in _numbered(text, count, results.path)]
        return check_frames(count, chosen, results.path)

    def _one(self) -> int | None:
        """The colony of an image or a lineage."""
        if len(self.colonies) > 1:
            raise checks.input_error("--colonies", self.colonies, "one colony, or left out")
        return self.colonies[0] if self.colonies else None

    def _table(self, results: Results) -> list[Path]:
        path = self._new(results, TABLE)
        frames = check_frames(len(results), self._frames(results), results.path)
        tables = Tables(results, results.lineage(), self.internals)
        with written_whole(path) as beside:
            for number, k in enumerate(
                frames
            ):  # one at a time: a run may be larger than the memory
                mode = "w" if number == 0 else "a"
                table = data_frame(tables([k]))
                table.to_csv(beside, mode=mode, header=number == 0, index=False)
        return [path]

    def _lives(self, results: Results) -> list[Path]:
        return self._whole_table(results, results.lineage().to_pandas())

    def _colonies(self, results: Results) -> list[Path]:
        frames, internals = self._frames(results), self.internals
        table = results.to_pandas(frames, each="colony", internals=internals)
        return self._whole_table(results, table)

    def _whole_table(self, results: Results, table: Any) -> list[Path]:
        path = self._new(results, TABLE)
        with written_whole(path) as beside:
            table.to_csv(beside, index=False)
        return [path]

    def _newick(self, results: Results) -> list[Path]:
        path, text = self._new(results, NEWICK), results.lineage().to_newick(self._one())
        write_whole(path, text)
        return [path]

    def _graph(self, results: Results) -> list[Path]:
        path, graph = self._new(results, GRAPH), results.lineage().to_networkx(self._one())
        with written_whole(path) as beside:
            needed("networkx", "tables").write_graphml(graph, beside)
        return [path]

    def _vtk(self, results: Results) -> list[Path]:
        return results.to_vtkhdf(
            self.out,
            colonies=self.colonies or None,
            frames=self._frames(results),
            rods=self.rods or "capsules",
            overwrite=self.overwrite,
        )

    def _labels(self, results: Results) -> list[Path]:
        return [results.to_labels(self.out, z=self.z, **self._pages(results))]

    def _fluorescence(self, results: Results) -> list[Path]:
        return [results.to_ome_tiff(self.out, **self._pages(results), **self._light())]

    def _folder(self, results: Results) -> list[Path]:
        if self.pixel_size is None:
            raise InputError(
                f"{self.out} has no suffix, so it is to be a folder in the format of the Cell"
                " Tracking Challenge, which needs --pixel-size, µm, such as --pixel-size 0.065."
                f" Files end in {', '.join(SUFFIXES)}."
            )
        return [results.to_ctc(self.out, z=self.z, **self._pages(results), **self._light())]

    def _light(self) -> dict[str, Any]:
        """The options of LIGHT that are given."""
        found = {n: getattr(self, n) for n in LIGHT if getattr(self, n) not in (None, [])}
        if self.channels:
            found["channels"] = dict(map(_gain, self.channels))
        return found

    def _pages(self, results: Results) -> dict[str, Any]:
        if self.pixel_size is None:
            raise InputError("an image needs --pixel-size, µm, such as --pixel-size 0.065.")
        if len(self.window) not in (0, 4):
            raise checks.input_error(
                "--window", self.window, "four numbers: LEFT BOTTOM RIGHT TOP, µm"
            )
        return {
            "pixel_size": self.pixel_size,
            "colony": self._one(),
            "frames": self._frames(results),
            "window": (self.window[:2], self.window[2:]) if self.window else None,
            "overwrite": self.overwrite,
        }

    def _new(self, results: Results, suffix: str) -> Path:
        return check_new_file(self.out, (suffix,), self.overwrite, results.path)


def _numbered(text: str, count: int, path: Path) -> list[int]:
    """The frames that a word of --frames names, of a file with `count`."""
    parts = text.split(":")
    try:
        numbers = [int(p) if p.strip() or len(parts) == 1 else None for p in parts]
        if len(numbers) == 1:
            return [int(text)]
        found = list(range(count)[slice(*numbers)])
    except (ValueError, TypeError):
        rule = "numbers of frames, or ranges START:STOP or START:STOP:STEP, such as 0 or 2:5"
        raise checks.input_error("--frames", text, rule) from None
    if not found:
        rule = f"a range with at least one of the frames 0 to {count - 1} of {path}"
        raise checks.input_error("--frames", text, rule)
    return found


def _gain(text: str) -> tuple[str, float]:
    name, _, number = text.partition("=")
    try:
        return name, float(number)
    except ValueError:
        rule = "a quantity and its gain, such as gfp=100"
        raise checks.input_error("--channels", text, rule) from None


def _content(form: str) -> str:
    known = {TABLE: "the table", COLONIES: "the table of colonies", VTK: "shapes"} | dict.fromkeys(
        (LIVES, NEWICK, GRAPH), "the lineage"
    )
    return {**known, FOLDER: "images, label masks and tracks"}.get(form, form)
