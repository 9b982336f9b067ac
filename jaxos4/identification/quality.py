"""Whether a fit explains a flight."""

COLOURED = 0.3
"""Residuals whose neighbours correlate by more than this are not white noise: intervals must allow for it."""
