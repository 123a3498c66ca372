"""Results files: writing a run, reading it, resuming from it."""
