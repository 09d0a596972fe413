"""Controllers that are not there: firmware emulators on pseudo-terminals, with selectable faults."""
