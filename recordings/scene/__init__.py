"""The rendered scene."""
