"""What a person or a script changes of a run while it goes on."""
