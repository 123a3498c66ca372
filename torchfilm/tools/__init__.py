"""General tools, without knowledge of cells."""
