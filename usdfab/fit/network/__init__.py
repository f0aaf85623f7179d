"""Stage 1: a network that guesses a fabric's parameters from one photo (Li et al. 2024, section 5.3)."""
