"""Training of propagation stencils on closed forms (``difflpv.training.stencils``)."""
