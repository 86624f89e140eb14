"""Files of the results: labels, tree, surfaces."""
