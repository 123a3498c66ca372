"""Kernels: tensors in and out, never a State."""
