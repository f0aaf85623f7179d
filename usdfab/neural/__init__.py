"""The multi-scale neural material (Chen et al. 2024): surface materials, their ground truth, data sets of it."""
