"""``turnscan scan``: list, show, tag, retire."""
