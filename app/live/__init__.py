"""The live loop, from a source to the results of frames."""
