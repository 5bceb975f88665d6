"""The report of an ablation over a grid of settings."""
