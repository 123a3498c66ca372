"""Kernels of contact mechanics: tensors in and out, never a State."""
