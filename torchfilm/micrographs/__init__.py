"""Cells from micrographs: tables of segmentation programs, label images, overlaps at the start."""
