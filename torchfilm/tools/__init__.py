"""Tools that know nothing of cells."""
