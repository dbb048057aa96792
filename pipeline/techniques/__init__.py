"""Techniques: each measures where predicted features really are, and says how well."""
