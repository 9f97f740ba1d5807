"""``difflpv view``: a page in the browser that shows a scene, its volume and its probes, and solves anew as sliders move."""
