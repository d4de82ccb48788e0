"""Shell: what was inspected is kept: results in a store, frames as sessions, so that every verdict can be explained."""
