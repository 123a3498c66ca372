"""The command that draws: `torchfilm show FILE`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from torchfilm import pictures
from torchfilm.pictures import cli_options
from torchfilm.pictures.page import figure_class
from torchfilm.tools import checks
from torchfilm.tools.checks import InputError


@dataclass
class Show:
    """Draw a frame of a results file, a strip of several, or a film of all."""

    file: Annotated[Path, tyro.conf.Positional]
    """Results file; a run may still be writing it."""
    frame: int = -1
    """Which frame; -1 is the last."""
    strip: int | None = None
    """Draw this many frames side by side, evenly spaced from first to last."""
    times: list[float] = field(default_factory=list)
    """Draw these times side by side, h."""
    movie: Path | None = None
    """Film the run: a new file that ends in .mp4 or .gif."""
    fps: float = 10.0
    """Frames per second of a film."""
    colour: str | None = None
    """The quantity that colours the cells: angle, growth_rate, cell_type, length, yfp, or any other
    quantity per cell; founder is a colour for each line of descent. By default the cell type where
    there are several, else the first species, else angle."""
    channels: list[str] = field(default_factory=list)
    """Instead of --colour: several quantities, each with the colour of its light, as NAME=COLOUR,
    such as --channels cfp=cyan yfp=yellow."""
    background: str | None = None
    """A signal to draw behind the cells, from white (lowest) to black (highest)."""
    limits: list[str] = field(default_factory=list)
    """Ranges of colours, as NAME=LOW:HIGH, such as --limits yfp=0:2."""
    log: list[str] | None = None
    """Logarithmic colours of these drawn quantities, such as --log yfp ahl; of all without names.
    """
    view: str = "xy"
    """xy, xz or yz."""
    section: str = "cells"
    """Which concentration of a signal to draw, along the line of sight: the one at the cells, the
    mean, or the one at a coordinate, µm."""
    whole: bool = False
    """Show the whole box of the medium."""
    colonies: list[int] = field(default_factory=list)
    """Which colonies, by their ids; by default all, up to 36 (4 in a strip, 9 in a film)."""
    out: Path | None = None
    """The picture: a new file, unless --overwrite is given. By default the run's own picture, which
    has the name of the results file with .png and is drawn again."""
    overwrite: bool = False
    """Replace the file given with --out or --movie, or the strip beside the results, if it
    exists."""

    def __call__(self) -> None:
        many = self.strip is not None or bool(self.times)
        self._check_one(many)
        # only the run's own picture is replaced without --overwrite
        out = (
            self.movie
            or self.out
            or (self.file.with_name(self.file.stem + "_strip.png") if many else None)
        )
        target = own_picture(self.file, out)
        if out is not None:
            check_new(
                "--movie" if self.movie else "--out",
                out,
                self.overwrite,
                "Choose another, or replace it with --overwrite.",
            )
        self._draw(target, many)
        print(target)

    def _check_one(self, many: bool) -> None:
        """Raise InputError for options that exclude one another."""
        if self.strip is not None and self.times:
            raise InputError("--strip, --times: give one of them.")
        chosen = {
            "--frame": self.frame != -1,
            "--strip or --times": many,
            "--movie": self.movie is not None,
        }
        both = self.movie is not None and self.out is not None
        if sum(chosen.values()) > 1 or both:
            given = [name for name, is_given in {**chosen, "--out": both}.items() if is_given]
            raise InputError(f"{', '.join(given)}: give one of them.")

    def _draw(self, out: Path, many: bool) -> None:
        options: dict[str, Any] = {
            "colour": self.colour,
            "channels": cli_options.channels_of(self.channels),
            "background": self.background,
            "limits": cli_options.limits_of(self.limits),
            "log": self.log is not None and (self.log or True),
            "view": self.view,
            "section": cli_options.section_of(self.section),
            "whole": self.whole,
            "colonies": self.colonies or None,
        }
        if self.movie is not None:
            pictures.movie(self.file, out, fps=self.fps, **options)
        elif many:
            pictures.strip(
                self.file, count=self.strip, times=self.times or None, out=out, **options
            )
        else:
            pictures.show(self.file, frame=self.frame, out=out, **options)


def check_new(name: str, path: Path, overwrite: bool, hint: str) -> None:
    """Raise InputError if the file exists and may not be replaced."""
    if path.exists() and not overwrite:
        raise checks.input_error(name, str(path), "a path where there is no file yet", hint)


def check_new_picture(name: str, path: Path) -> None:
    """Raise InputError if a picture cannot be made at this path, or if there is a file."""
    figure_class()
    if path.suffix.lower() not in (".png", ".pdf", ".svg") or not path.parent.is_dir():
        rule = "in a folder that exists, with a name that ends in .png, .pdf or .svg"
        raise checks.input_error(name, str(path), rule)
    check_new(name, path, False, "Choose another.")


def own_picture(results: Path, out: Path | None = None) -> Path:
    """The picture that belongs to a results file, or `out`. Raises InputError if it is the results
    file itself, or if the results are a folder."""
    if results.is_dir():
        raise checks.input_error("results", str(results), "a results file", "This is a folder.")
    picture = results.with_suffix(".png") if out is None else out
    if picture.absolute() == results.absolute():
        hint = "Give the results a name that does not end in .png, or draw with show --out."
        raise checks.input_error("picture", str(picture), "another file than the results", hint)
    return picture
