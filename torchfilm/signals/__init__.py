"""Signals: concentrations on one regular grid per colony. Kernels: tensors in and out, never a
State."""
