"""The files of a recording, and the messages in them by topic."""
