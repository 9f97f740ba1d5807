"""What is seen of a solve, as coloured triangles: surfaces, SH lobes, shaded spheres, tubes."""
