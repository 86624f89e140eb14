"""Recordings of Azure Kinect and Orbbec Femto cameras in Matroska files (``.mkv``)."""
