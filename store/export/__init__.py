"""Point tables to files that other programs read, one format a module."""
