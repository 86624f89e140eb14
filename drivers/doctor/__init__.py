"""Why a camera does not work."""
