"""Fields of classes: checks of their values, ranges and units, and columns of tables."""
