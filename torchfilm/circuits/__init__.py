"""Circuits: reactions inside cells and the integrators that carry them forward. Tensors in and out,
never a State."""
