"""What live cameras of all drivers share: settings, clock, process and readers."""
