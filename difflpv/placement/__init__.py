"""Where to put light probes: every way of placing them behind one interface."""
