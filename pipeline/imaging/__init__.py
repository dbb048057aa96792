"""Pixels: background and noise, masks, point sources."""
