"""The function of position that lookups evaluate: what lies between the stored values."""
