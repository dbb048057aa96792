"""Sample archives with planted truth, made without any of the navigator's code."""
