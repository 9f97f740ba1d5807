"""Light probes: what they hold, how receivers read them, and the fields that fill them."""
