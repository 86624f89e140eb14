"""The command nurbseg-devices."""
