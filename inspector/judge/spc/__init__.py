"""What the panels of the last hours say of the paint line. Pure: panels in, statistics out; no clock, no file."""
