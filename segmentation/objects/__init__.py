"""Objects: surfaces that belong together, and the evidence for it."""
