"""The command nurbseg-live: flags, configuration file, exit codes."""
