"""Signals: concentrations on one regular grid per colony. Tensors in and out, never a State."""
