"""Compiled kernels for the CPU: loops over arrays, which know nothing of states or effects."""
