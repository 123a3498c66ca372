"""Circuits: reactions inside cells and their integrators. Tensors in and out, never a State."""
