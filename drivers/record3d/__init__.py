"""Recordings of the app Record3D, of iPhones and iPads: ``pip install 'nurbseg[record3d]'``."""
