"""The source process, which reads a camera or a recording, plays it and records it, and its client."""
