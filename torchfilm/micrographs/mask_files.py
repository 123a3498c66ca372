"""Images from files and arrays: label images, and micrographs to draw over."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import numpy as np

from torchfilm.tools import checks
from torchfilm.tools.warn_once import warn

EXTRA = f"Images require scikit-image and tifffile: {checks.install('images')}."
# files of programs that hold more than an image, and how to get at the image
NOT_IMAGES = {
    ".mat": "Read it by scipy.io.loadmat, and give the array of labels (SuperSegger:"
    ' loadmat(file, simplify_cells=True)["regs"]["regs_label"]).',
    ".h5": 'Read it by h5py, and give the array of labels (ilastik: file["exported_data"][0]).',
    ".pkl": "Give a label image.",
    ".csv": "For a table, use Cells.from_table.",
}


def read_image(image: Any, frame: int | None, what: str) -> tuple[np.ndarray, str, int]:
    """An image (rows, columns) or (rows, columns, 3 or 4), a name for messages, and of how many
    frames it is one.

    image: an array, or the path of a file: .tif, .tiff, .png, .jpg, .npy, or DeLTA's .nc, whose
    label images are placed where their regions of interest were. frame: of a stack, −1 is the last;
    required if it has several. what: "mask", "micrograph" or a word for another image. Nothing in
    a file can execute.
    """
    if isinstance(image, (str, Path)):
        path = Path(image)
        values, source = _file(path, frame, what), str(path)
        if path.suffix.lower() == ".nc":
            return values, source, 1
    else:
        values, source = _array(image, what), what if "[" in what else f"the {what}"
    if values.ndim == 3 and values.shape[-1] in (3, 4) and min(values.shape[:2]) > 4:
        return _one_frame(values[None], frame, source)
    while values.ndim > 3 and 1 in values.shape[:-2]:
        values = values.squeeze(values.shape.index(1))
    if values.ndim == 2:
        values = values[None]
    if values.ndim != 3 and not (values.ndim == 4 and values.shape[-1] in (3, 4)):
        raise checks.InputError(
            f"{source} has the shape {values.shape}: it must be an image (rows, columns), or a"
            " stack of them (frames, rows, columns)."
        )
    return _one_frame(values, frame, source)


def _one_frame(stack: np.ndarray, frame: int | None, source: str) -> tuple[np.ndarray, str, int]:
    count = len(stack)
    if frame is None:
        if count != 1:
            raise checks.InputError(
                f"{source} has {count} frames: say which one by frame=…, from 0 to {count - 1}. If"
                " they are channels, give the array of one channel, such as tifffile.imread(…)[0]."
            )
        frame = 0
    elif isinstance(frame, bool) or not isinstance(frame, (int, np.integer)):
        raise checks.input_error("frame", frame, "a whole number")
    if not -count <= frame < count:
        frames = "1 frame" if count == 1 else f"{count} frames"
        rule = f"from {-count} to {count - 1}: {source} has {frames}"
        raise checks.input_error("frame", frame, rule)
    name = source if count == 1 else f"{source}, frame {frame % count}"
    return stack[frame], name, count


def _array(image: Any, what: str) -> np.ndarray:
    try:
        values = np.asarray(image.detach().cpu() if hasattr(image, "detach") else image)
    except (TypeError, ValueError) as error:
        raise checks.input_error(what, image, "an array or the path of an image") from error
    if values.dtype.kind not in "biuf" or not values.size:
        raise checks.input_error(
            what, f"an array of {values.dtype}, {values.shape}", "an array of numbers, not empty"
        )
    return values


def _file(path: Path, frame: int | None, what: str) -> np.ndarray:
    """The values of a file. Raises InputError if it cannot be read, whatever the library says."""
    kind = path.suffix.lower()
    if kind in NOT_IMAGES:
        raise checks.InputError(f"{path} is not an image. {NOT_IMAGES[kind]}")
    if kind in (".jpg", ".jpeg") and what != "micrograph":
        raise checks.InputError(f"{path}: JPEG changes numbers. Save it as .tif or .png.")
    if kind not in (".tif", ".tiff", ".png", ".jpg", ".jpeg", ".npy", ".nc"):
        raise checks.input_error(what, str(path), "a file .tif, .png, .npy or .nc, or an array")
    try:
        if path.stat().st_size == 0:
            raise checks.InputError(f"{path} is empty: it has no bytes.")
    except OSError as error:
        raise checks.InputError(f"{path} cannot be read: {error.strerror or error}.") from error
    if kind == ".nc":
        return _delta_labels(path, frame)
    try:
        return _array(_read(path, kind, frame), what)
    except checks.InputError:
        raise
    except Exception as error:  # the libraries raise errors of many kinds for a broken file
        hint = (
            " It may hold Python objects, which are not loaded since they can execute code; save"
            " the masks alone, as .tif."
            if kind == ".npy" and "pickle" in str(error)
            else " Install imagecodecs, or save the image without compression."
            if "imagecodecs" in str(error)
            else " Is it truncated, or a file of another kind?"
        )
        raise checks.InputError(
            f"{path} cannot be read as {kind[1:].upper()} ({error}).{hint}"
        ) from error


# axes of a TIFF file that are not frames in time
STACKS = {"C": "channels", "Z": "planes"}


def _read(path: Path, kind: str, frame: int | None) -> np.ndarray:
    if kind == ".npy":
        return np.load(path, allow_pickle=False)
    try:
        import tifffile
        from PIL import Image
    except ImportError as error:
        raise checks.InputError(EXTRA) from error
    if kind in (".tif", ".tiff"):
        with tifffile.TiffFile(path) as file:
            first = file.series[0]
            sizes = {a: n for a, n in zip(first.axes, first.shape, strict=True) if n > 1}
            stacks = [axis for axis in sizes if axis not in "YXS"]
            for axis in [a for a in stacks if a in STACKS]:
                words = f"{path} is a stack of {sizes[axis]} {STACKS[axis]} (axes {first.axes})"
                if frame is None or len(stacks) > 1:
                    raise checks.InputError(
                        f"{words}, and one is wanted. Give the array of one: its part of"
                        f" tifffile.imread({path.name!r})."
                    )
                warn(f"{words}; frame={frame} takes one of these. Were they taken at one time?")
            return _pages(file, path)
    with Image.open(path) as image:
        # the numbers of a palette are the labels
        return np.asarray(image)


def _pages(file: Any, path: Path) -> np.ndarray:
    """The images of a TIFF file: those that were written one by one are a stack."""
    series = file.series
    like = {(x.shape, x.dtype) for x in series}
    if len(series) > 1 and len(like) == 1 and len(series[0].shape) == 2 and not file.is_ome:
        return np.stack([x.asarray() for x in series])
    if len(series) > 1:
        warn(
            f"{path} holds {len(series)} series of images, of shapes"
            f" {', '.join(str(x.shape) for x in series[:4])}{', …' if len(series) > 4 else ''}; the"
            " first is taken. For another give its array, such as"
            f" tifffile.imread({path.name!r}, series=1)."
        )
    return series[0].asarray()


def _delta_labels(path: Path, frame: int | None) -> np.ndarray:
    """The label image of a frame of DeLTA's results (netCDF, which is HDF5): a group roi00, roi01,
    … for each region of interest, with label_stack (frame, rows, columns), the numbers of the
    frames, and its box in the image. Cells of several regions are numbered on."""
    import h5py

    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise checks.InputError(f"{path} cannot be read as netCDF ({error}).") from error
    with file:
        checks.only_own_data(file)
        groups = [file[name] for name in sorted(file) if name.startswith("roi")]
        if not groups or any("label_stack" not in g or "frame" not in g for g in groups):
            raise checks.InputError(
                f"{path} is not a results file of DeLTA: it requires groups roi00, roi01, … with"
                " label_stack and frame."
            )
        parts, count = [], 0
        for group in groups:
            try:
                box = ast.literal_eval(_text(group.attrs["box"]))
                top, left = int(box["ytl"]), int(box["xtl"])
            except (KeyError, ValueError, SyntaxError, TypeError) as error:
                raise checks.InputError(
                    f"{path}, group {group.name}: the attribute box is missing or not readable."
                ) from error
            numbers = [int(n) for n in group["frame"][()]]
            if frame is None and len(numbers) == 1:
                frame = numbers[0]
            if frame not in numbers:
                raise checks.input_error(
                    "frame", frame, f"one of {numbers[0]} to {numbers[-1]}, the frames of {path}"
                )
            labels = np.asarray(group["label_stack"][numbers.index(frame)], dtype=np.int64)
            parts.append((top, left, np.where(labels > 0, labels + count, 0)))
            count += int(labels.max())
    whole = np.zeros(
        (max(t + x.shape[0] for t, _, x in parts), max(c + x.shape[1] for _, c, x in parts)),
        dtype=np.int64,
    )
    for top, left, labels in parts:
        part = whole[top : top + labels.shape[0], left : left + labels.shape[1]]
        part[labels > 0] = labels[labels > 0]
    return whole


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)
