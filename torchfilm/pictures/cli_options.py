"""Picture options from the texts of a command line."""

from __future__ import annotations

from collections.abc import Sequence

from torchfilm.tools import checks


def channels_of(texts: Sequence[str]) -> dict[str, str] | None:
    """Channels from texts NAME=COLOUR; None without any."""
    return dict(_pair("--channels", text, "NAME=COLOUR") for text in texts) or None


def limits_of(texts: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Limits from texts NAME=LOW:HIGH."""
    limits = {}
    for text in texts:
        name, value = _pair("--limits", text, "NAME=LOW:HIGH")
        try:
            low, high = map(float, value.split(":"))
        except ValueError as error:
            raise checks.input_error("--limits", text, "NAME=LOW:HIGH, with two numbers") from error
        limits[name] = (low, high)
    return limits


def section_of(text: str) -> float | str:
    """A section: a coordinate, or a word."""
    try:
        return float(text)
    except ValueError:
        return text


def _pair(option: str, text: str, form: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (equals and name and value):
        raise checks.input_error(option, text, form)
    return name, value
