"""Recording during a run, and checks of recordings."""
