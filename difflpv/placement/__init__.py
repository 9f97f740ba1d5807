"""Where to put light probes: every way of placing them behind one interface, and the judge of all of them."""
