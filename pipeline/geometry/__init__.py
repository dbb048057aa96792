"""Rotations, pointing corrections, astrometry and (for bodies and rings) shapes."""
