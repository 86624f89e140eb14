"""Recordings whose images a program's own index or names put together."""
