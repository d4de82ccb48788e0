"""Recorded sessions inspected again: `inspector replay` and `inspector reinspect`."""
