"""What the commands do that have no package of their own."""
