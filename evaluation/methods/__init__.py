"""The methods to compare with."""
