"""The demo recording, which is installed with the program."""
