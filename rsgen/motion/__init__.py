"""Parametric camera motions, made to a given length and mean speeds: lines, rolls, waypoint tours, with hand-shake."""
