"""How contacts are computed, in words."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from torchfilm.kernels.bilateral_scheme import PENALTY, TOLERANCE
from torchfilm.parameters import number_range
from torchfilm.physics.adhesion import Adhesion
from torchfilm.physics.contact_records import ContactSettings
from torchfilm.physics.one_sided_records import OneSidedSettings
from torchfilm.values import is_drawn, numbers

if TYPE_CHECKING:
    from torchfilm.effects.mechanics import Mechanics


def numerics_in_words(effect: Mechanics, dt: float, device: torch.device) -> list[str]:
    """How a scene's contacts are computed in steps of dt hours, in lines."""
    settings = effect.settings
    kind = _hardness(effect, settings, dt)
    if isinstance(settings, OneSidedSettings):
        lines = _of_one_sided(effect, settings, kind, device)
    else:
        lines = _of_bilateral(effect, settings, kind, device)
    lines += [_of_adhesion(kind) for kind in effect.adhesion]
    soft = [w for w in effect.walls if w.stiffness is not None or w.weight is not None]
    if effect.walls:
        hard = len(effect.walls) - len(soft)
        lines.append(f"walls: {hard} hard, {len(soft)} with a stiffness or weight")
    if effect.periodic_space is not None:
        lines.append(f"periodic: {effect.periodic_space.told}")
    return lines


def _hardness(effect: Mechanics, settings: OneSidedSettings | ContactSettings, dt: float) -> str:
    """How hard contacts are."""
    text = number_range
    if effect.stiffness is not None:
        alpha = 1.0 / (numbers(effect.stiffness) * dt)
        return (
            f"soft, stiffness {text(numbers(effect.stiffness))} μ·µm/h: α = 1/(stiffness·Δt) ="
            f" {text(alpha)}"
        )
    if effect.alpha is not None:
        return f"hard by a penalty, α = {text(numbers(effect.alpha))}"
    if isinstance(settings, OneSidedSettings):
        return f"as hard as leaves a mean overlap of {settings.contact_overlap:g} radii"
    alpha = PENALTY / numbers(effect.length_drag)
    return f"hard by a penalty, α = {PENALTY:g}/γ = {text(alpha)} (default)"


def _of_one_sided(
    effect: Mechanics, settings: OneSidedSettings, kind: str, device: torch.device
) -> list[str]:
    deep = (
        f"{settings.too_deep:g} radii"
        if settings.overlap is None
        else f"{settings.overlap:g} µm (a small bound takes off growth under pressure; a smaller"
        " contact_overlap does not)"
    )
    passes = (
        "1 a step, as cells are soft"
        if settings.soft
        else f"at most {settings.passes} a step, more than one only around cells deeper than {deep}"
    )
    return [
        f"contacts: one-sided, they only push; {kind}",
        (
            f"passes: {passes}; a colony with a cell that grows more than"
            f" {effect.max_elongation:g} µm takes sub-steps"
        ),
        (
            f"solver: Newton and conjugate gradients, {_who(effect, device)}, contact forces"
            f" to {settings.tolerance:g}, at most {effect.max_iterations} iterations a solve"
        ),
    ]


def _who(effect: Mechanics, device: torch.device) -> str:
    who = effect.backend_on(device)
    by = "assembled by torch" if effect.one_sided else "by torch"
    return f"{who}; {by} where gradients are required" if who == "compiled" else who


def _of_bilateral(
    effect: Mechanics, settings: ContactSettings, kind: str, device: torch.device
) -> list[str]:
    over = (
        ""
        if effect.overlap is None
        else f", more than one only for new contacts and overlaps over {effect.overlap:g} µm"
    )
    return [
        f"contacts: bilateral, an overlapping pair is held until the next pass; {kind}",
        (
            f"passes: at most {settings.passes} a step{over}; a colony with a cell that grows"
            f" more than {effect.max_elongation:g} µm takes sub-steps of up to"
            f" {settings.coarse_passes} passes"
        ),
        (
            f"solver: conjugate gradients, {_who(effect, device)}, each colony to a worst residual"
            f" of {_tolerance(effect)}, at most {effect.max_iterations} iterations"
        ),
    ]


def _tolerance(effect: Mechanics) -> str:
    if effect.tolerance is not None:
        return f"{effect.tolerance:g}"
    default = effect.alpha is None and effect.stiffness is None
    less = "" if default else f"; less where α·γ is below {PENALTY:g}"
    return f"{TOLERANCE:g} (default{less})"


def _of_adhesion(kind: Adhesion) -> str:
    """An adhesion in words."""
    strength = kind.strength
    pull = f"{number_range(numbers(strength))} μ·µm²/h"
    pull = "a strength drawn for each cell" if is_drawn(strength) else f"up to {pull}"
    levels = " and ".join(kind.levels)
    by = f", in proportion to {levels}" + " of both cells" * (kind.to == "cells") if levels else ""
    to = {"cells": "", "walls": " of each end to walls"}.get(str(kind.to), f" to wall {kind.to}")
    return f"adhesion{to}: a pull of {pull} at a gap of {kind.reach:g} µm{by}"
