"""Devices: what a recording session asks of them (contracts), and the drivers that answer."""
