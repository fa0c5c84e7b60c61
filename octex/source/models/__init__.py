"""Model files read as surfaces."""
