"""Old data and devices to events to a scan log: importers, the simulated room."""
