"""The paint process in closed loop, proved and shown without a plant."""
