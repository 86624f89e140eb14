"""What cameras of any kind are wrapped in."""
