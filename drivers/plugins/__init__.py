"""Sources of other packages."""
