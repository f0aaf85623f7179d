"""Data sets of rendered fabrics with their parameters: sampled, rendered, stored and read back. Needs no torch."""
