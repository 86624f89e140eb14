"""What cameras and recordings are wrapped in while they are live."""
