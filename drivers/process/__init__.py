"""Other processes of ours: how they are started."""
