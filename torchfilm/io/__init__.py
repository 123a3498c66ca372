"""Results files: writing a run, reading it back, resuming from it."""
