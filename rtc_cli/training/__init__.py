"""Training of flow policies: the optimisation loop and its checkpoints."""
