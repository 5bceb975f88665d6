"""Analyses of cost: the time of one chunk per sampler."""
